//! One inference thread: get ready for new models, take what arrived, tick, show a sign of life.

use super::{Shared, Ticket, cost::Load, queue::Room, tick::Batch};
use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Arc,
    thread::{Builder, JoinHandle, sleep},
    time::Duration,
};

const STACK_BYTES: usize = 8 << 20;
/// After a panic outside of an act: what panics each time must not take the processor.
const PAUSE: Duration = Duration::from_millis(20);

pub(super) fn spawn<T: Ticket>(shared: Arc<Shared<T>>, index: usize) -> io::Result<JoinHandle<()>> {
    Builder::new().name(format!("ada-engine-{index}")).stack_size(STACK_BYTES).spawn(move || supervise(&shared, index))
}

/// Runs the worker to the engine's end, whatever panics in it. A panic of the model is the failure of an act, and caught where it happens; one
/// anywhere else (a ticket, a metric) costs the acts of this batch, whose tickets are dropped, and not the thread.
fn supervise<T: Ticket>(shared: &Shared<T>, index: usize) {
    let mut batch = Batch::new(shared.options);
    while catch_unwind(AssertUnwindSafe(|| run(shared, index, &mut batch))).is_err() {
        metrics::counter!("ada_engine_panics_total").increment(1);
        tracing::error!(worker = index, acts = batch.len(), "an inference thread panicked outside of the model; its acts are given up");
        batch.abandon();
        sleep(PAUSE);
    }
    batch.stop();
}

fn run<T: Ticket>(shared: &Shared<T>, index: usize, batch: &mut Batch<T>) {
    loop {
        shared.beat(index);
        let asked = shared.warm_ups[index].lock().as_mut().map(std::mem::take).unwrap_or_default();
        for (agent, done) in asked {
            let go_on = || {
                shared.beat(index);
                !shared.queue.is_closed()
            };
            // Whoever asked may have gone meanwhile.
            let _gone = done.send(batch.warm_up(&agent, &shared.tariff, go_on));
        }
        loop {
            let (held, rows, len_max) = (batch.len(), batch.rows(), shared.options.batch_len_max);
            let turns = batch.turns();
            let reserve = (len_max + turns.reserve()).saturating_sub(rows.max(len_max));
            let room = Room { any: len_max.saturating_sub(rows), light: reserve };
            let Some(arrivals) = shared.queue.take(index, held, room, |client| turns.is_heavy(client)) else { return };
            let full = Load { acts: held + arrivals.len(), rows: rows + arrivals.iter().map(|job| job.act.rows()).sum::<usize>() };
            for job in arrivals {
                batch.admit(*job, full, &shared.tariff);
            }
            // The place of one that came too late is the next one's.
            if batch.len() == full.acts {
                break;
            }
        }
        batch.tick();
    }
}
