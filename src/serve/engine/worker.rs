//! One inference thread: get ready for new models, take what arrived, tick, show a sign of life.

use super::{Shared, Ticket, tick::Batch};
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
    let mut batch = Batch::new(shared.options);
    let mut ended = 0;
    loop {
        shared.beat(index);
        let asked = shared.warm_ups[index].lock().as_mut().map(std::mem::take).unwrap_or_default();
        for (agent, done) in asked {
            // Whoever asked may have gone meanwhile.
            let go_on = || {
                shared.beat(index);
                !shared.queue.is_closed()
            };
            let _gone = done.send(batch.warm_up(&agent, go_on));
        }
        let held = batch.len();
        let Some(arrivals) = shared.queue.take(held, ended, shared.options.batch_len_max.saturating_sub(held)) else { break };
        let before = held + arrivals.len();
        for job in arrivals {
            batch.admit(*job);
        }
        batch.tick();
        ended = before - batch.len();
    }
    batch.stop();
}
