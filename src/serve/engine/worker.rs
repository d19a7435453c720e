//! One inference thread: take what arrived, tick, show a sign of life.

use super::{Failure, Shared, Ticket, tick::Batch};
use std::{
    io,
    sync::Arc,
    thread::{Builder, JoinHandle},
};

const STACK_BYTES: usize = 8 << 20;

pub(super) fn spawn<T: Ticket>(shared: Arc<Shared<T>>, index: usize) -> io::Result<JoinHandle<()>> {
    Builder::new().name(format!("ada-engine-{index}")).stack_size(STACK_BYTES).spawn(move || run(&shared, index))
}

fn run<T: Ticket>(shared: &Shared<T>, index: usize) {
    let mut batch = Batch::default();
    let mut ended = 0;
    loop {
        shared.beat(index);
        let held = batch.len();
        let Some(arrivals) = shared.queue.take(held, ended, shared.batch_len_max.saturating_sub(held)) else { break };
        let before = held + arrivals.len();
        for job in arrivals {
            batch.admit(*job);
        }
        batch.tick();
        ended = before - batch.len();
    }
    for ticket in batch.into_tickets() {
        ticket.settle(Err(Failure::Stopped));
    }
}
