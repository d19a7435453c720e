use super::*;

fn queue(len: usize, workers: usize) -> Queue<i32> {
    Queue::new(Bounds { len, bytes: 100 }, workers)
}

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

/// Of client 0, with a turn at `turn_by`, and no wish beyond that.
fn ask(turn_by: Instant, bytes: usize) -> Ask {
    Ask { turn_by, client: 0, rows: 1, work: Duration::ZERO, bytes, wait_max: Duration::MAX, useful: Duration::MAX }
}

impl Queue<i32> {
    fn take_any(&self, worker: usize, held: usize, any: usize) -> Option<Vec<i32>> {
        self.take(worker, held, Room { any, light: 0 }, |_| false)
    }

    fn put(&self, job: i32, ask: Ask) -> Result<Place, Refusal> {
        match self.push(job, ask) {
            Ok((place, None)) => Ok(place),
            Ok((_, Some(displaced))) => panic!("{displaced} had to leave"),
            Err((refusal, back)) => {
                assert_eq!(back, job);
                Err(refusal)
            }
        }
    }
}

#[test]
fn bounded_and_left_at_once() {
    let (queue, now) = (queue(2, 1), Instant::now());
    let first = queue.put(1, ask(now, 1)).unwrap();
    assert!(queue.put(2, ask(now, 1)).is_ok());
    assert_eq!(queue.put(3, ask(now, 1)), Err(Refusal::Full));
    assert_eq!((queue.withdraw(first), queue.withdraw(first)), (Some(1), None));
    assert!(queue.put(3, ask(now, 1)).is_ok(), "who leaves makes room");
    assert_eq!(queue.put(4, ask(now, 1)), Err(Refusal::Full));
    assert_eq!(queue.take_any(0, 0, 8), Some(vec![2, 3]));
    assert_eq!(queue.load(), (0, 2));
    assert_eq!(queue.take_any(0, 1, 8), Some(vec![]), "does not wait while it holds one");
    assert_eq!(queue.load(), (0, 1));
    assert_eq!(queue.close(), Vec::<i32>::new());
    assert_eq!(queue.put(5, ask(now, 1)), Err(Refusal::Closed));
    assert_eq!(queue.take_any(0, 0, 8), None);
}

/// An act may be told of thousands of steps: what waits is bounded in bytes too, but whatever fits into a message has its turn alone.
#[test]
fn bounded_in_bytes() {
    let (queue, now) = (queue(9, 1), Instant::now());
    let large = queue.put(1, ask(now, 1000)).unwrap();
    assert_eq!(queue.put(2, ask(now, 1)), Err(Refusal::Full));
    queue.withdraw(large);
    assert!(queue.put(3, ask(now, 60)).is_ok() && queue.put(4, ask(now, 40)).is_ok());
    assert_eq!(queue.put(5, ask(now, 1)), Err(Refusal::Full));
    assert_eq!(queue.take_any(0, 0, 1), Some(vec![3]));
    assert!(queue.put(6, ask(now, 60)).is_ok());
    assert_eq!(queue.close(), [4, 6]);
}

#[test]
fn workers_share() {
    let (queue, now) = (queue(16, 2), Instant::now());
    for job in 0..5 {
        queue.put(job, ask(now, 1)).unwrap();
    }
    assert_eq!(queue.take_any(0, 0, 8).unwrap().len(), 3);
    assert_eq!(queue.take_any(1, 0, 8).unwrap().len(), 2);
    for job in 0..9 {
        queue.put(job, ask(now, 1)).unwrap();
    }
    assert_eq!(queue.take_any(0, 2, 1).unwrap().len(), 1, "no more than there is room");
    assert_eq!(queue.load(), (8, 5));
    queue.take_any(0, 0, 0);
    assert_eq!(queue.load(), (8, 2), "a worker that holds nothing any more, for whatever reason, runs nothing");
}

/// The earliest deadline first; and with a stream of acts that are always more urgent when they come, an old one still gets its turn
/// as soon as its own deadline is the earliest.
#[test]
fn earliest_deadline_first_and_nobody_starves() {
    let (queue, now) = (queue(64, 1), Instant::now());
    let at = |after| now + ms(after);
    for (job, after) in [(1, 30), (2, 10), (3, 20), (4, 10)] {
        queue.put(job, ask(at(after), 1)).unwrap();
    }
    assert_eq!(queue.take_any(0, 0, 3), Some(vec![2, 4, 3]));
    assert_eq!(queue.take_any(0, 0, 3), Some(vec![1]));
    queue.put(0, ask(at(100), 1)).unwrap();
    let mut turns = 0;
    for arrival in 1.. {
        queue.put(arrival, ask(at(arrival as u64 * 10 + 5), 1)).unwrap();
        turns += 1;
        if queue.take_any(0, 0, 1).unwrap() == [0] {
            break;
        }
    }
    assert_eq!(turns, 10);
}

/// Whoever would wait for too long learns it at once, and why; whoever has its turn before those that wait does not count them.
#[test]
fn admitted_by_expected_wait() {
    let (queue, now) = (queue(64, 2), Instant::now());
    // Two workers: ten acts of 20 ms are 100 ms of waiting.
    for job in 0..10 {
        queue.put(job, Ask { client: job as u64, work: ms(20), ..ask(now + ms(50), 1) }).unwrap();
    }
    let late = Ask { client: 99, work: ms(20), ..ask(now + ms(60), 1) };
    assert_eq!(queue.put(10, Ask { wait_max: ms(70), ..late }), Err(Refusal::Slow(ms(30))));
    assert_eq!(queue.put(10, Ask { wait_max: ms(70), useful: ms(60), ..late }), Err(Refusal::Late));
    assert!(queue.put(10, Ask { wait_max: ms(100), ..late }).is_ok());
    assert!(queue.put(11, Ask { turn_by: now + ms(40), client: 98, wait_max: ms(0), ..late }).is_ok(), "the first of all waits for nobody");
    assert_eq!(queue.take_any(0, 0, 1), Some(vec![11]));
    assert_eq!((queue.expected_wait(), queue.slowness()), (ms(110), 1.0));
}

/// One client's hundred acts wait behind one another, so another's one act has its turn soon; and where they have filled the queue the last
/// of them leaves it.
#[test]
fn one_clients_crowd_is_its_own() {
    let (queue, now) = (queue(50, 1), Instant::now());
    let crowd = |job| queue.push(job, Ask { client: 1, work: ms(10), ..ask(now + ms(100), 1) });
    for job in 0..50 {
        assert!(matches!(crowd(job), Ok((_, None))));
    }
    assert!(matches!(crowd(50), Err((Refusal::Full, 50))), "its own last one is no reason to leave");
    let other = queue.push(100, Ask { client: 2, work: ms(10), ..ask(now + ms(105), 1) });
    assert!(matches!(other, Ok((_, Some(49)))), "the last of the crowd");
    let first: Vec<_> = (0..3).filter_map(|_| queue.take_any(0, 0, 1)).flatten().collect();
    assert_eq!(first, [0, 100, 1]);
    (0..48).for_each(|_| drop(queue.take_any(0, 0, 1)));
    assert!(queue.inner.lock().clients.is_empty(), "who has nothing here is forgotten");
}

/// Where a heavy client has filled the batch, others still find a place.
#[test]
fn places_are_kept_for_the_light() {
    let (queue, now) = (queue(9, 1), Instant::now());
    for (job, client) in [(0, 1), (1, 1), (2, 2), (3, 1), (4, 3), (5, 2)] {
        queue.put(job, Ask { client, ..ask(now, 1) }).unwrap();
    }
    let room = |any, light| Room { any, light };
    let heavy = |client| client == 1;
    assert_eq!(queue.take(0, 8, room(0, 2), heavy), Some(vec![2, 4]));
    assert_eq!(queue.take(0, 8, room(0, 0), heavy), Some(vec![]));
    assert_eq!(queue.take(0, 0, room(1, 2), heavy), Some(vec![0, 5]));
    assert_eq!(queue.take(0, 0, room(9, 2), heavy), Some(vec![1, 3]));
}

/// A batch holds so many rows, and not so many acts: one of many rows waits until they are free, nobody overtakes it meanwhile, and one of more
/// than there ever are is taken alone. Once 64 acts of 64 candidates were taken into one batch of 64.
#[test]
fn room_is_counted_in_rows() {
    let (queue, now) = (queue(99, 1), Instant::now());
    for (job, rows) in [(0, 3), (1, 4), (2, 2), (3, 1), (4, 100), (5, 1)] {
        queue.put(job, Ask { rows, client: job as u64, ..ask(now, 1) }).unwrap();
    }
    assert_eq!(queue.take_any(0, 0, 8), Some(vec![0, 1]));
    assert_eq!(queue.take_any(0, 2, 1), Some(vec![]), "nobody overtakes");
    assert_eq!(queue.take_any(0, 1, 4), Some(vec![2, 3]));
    assert_eq!(queue.take_any(0, 1, 7), Some(vec![]), "it is larger than any room");
    assert_eq!(
        queue.take(0, 1, Room { any: 7, light: 2 }, |_| false),
        Some(vec![5]),
        "others still find the places that are kept for them"
    );
    assert_eq!(queue.take_any(0, 0, 8), Some(vec![4]), "alone");
    assert_eq!(queue.load(), (0, 1));
}

/// After a hiccup the pace is slow, and if it counted while nobody waits, acts would be refused that nothing would ever measure again.
#[test]
fn a_pace_of_the_past_counts_only_while_others_wait() {
    let (queue, now) = (queue(9, 1), Instant::now());
    queue.inner.lock().pace.now = 8.0;
    assert_eq!(queue.slowness(), 1.0);
    let place = queue.put(1, ask(now, 1)).unwrap();
    assert_eq!(queue.slowness(), 8.0);
    queue.withdraw(place);
    assert_eq!(queue.slowness(), 1.0);
}

/// The pace is what it was seen to be while others waited, and what warm-up promised before.
#[test]
fn pace_follows_the_workers() {
    let (mut pace, begin) = (Pace::new(2), Instant::now());
    assert_eq!(pace.wait(ms(10)), ms(5));
    // Work of 1 ms an act, 64 acts in 192 ms, again and again: three times as long as the work, six times the promise.
    for round in 0..40 {
        pace.note(64, ms(64), true, begin + ms(192) * round);
    }
    assert!((pace.now - 3.0).abs() < 0.01, "{}", pace.now);
    let slow = pace.now;
    pace.note(64, ms(64), false, begin + ms(10_000));
    pace.note(64, ms(64), true, begin + ms(20_000));
    assert_eq!(pace.now, slow, "an empty queue says nothing");
    pace.note(64, ms(64), true, begin + ms(1_000_000));
    assert!(pace.now < slow + NEWEST_PACE * 5.0, "and a hiccup not much: {}", pace.now);
}
