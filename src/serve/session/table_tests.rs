//! The table: places, and who gives them.

use super::*;
use crate::{
    model::checkpoint,
    serve::{
        session::Standing,
        store::{Durability, Embedded, Options},
    },
};
use std::path::Path;

const MINUTE: Duration = Duration::from_secs(60);

fn table(len_max: usize) -> (Sessions, impl Fn() -> Opening) {
    let agent = Arc::new(checkpoint::load(Path::new("models/tiny")).unwrap());
    let opening = move || {
        let (options, ttl) = (agent.config().defaults.sampler.clone(), 60 * MINUTE);
        let episode = agent.open(1, &options).unwrap();
        Opening {
            model: "tiny".into(),
            agent: agent.clone(),
            episode: Arc::new(episode),
            standing: Standing::default(),
            ttl,
            request_id: String::new(),
            known: None,
        }
    };
    (Sessions::new(SessionsConfig { len_max, evict_idle_ms: 60_000, ..SessionsConfig::default() }, None), opening)
}

#[test]
fn the_longest_idle_gives_its_place() {
    let (sessions, opening) = table(3);
    let begin = Instant::now();
    let ids = [0, 1, 2].map(|minute| sessions.open(opening(), begin + minute * MINUTE).unwrap().id);
    sessions.get(ids[0], begin + 3 * MINUTE).unwrap();
    sessions.open(opening(), begin + 4 * MINUTE).unwrap();
    let ended = ids.map(|id| sessions.get(id, begin + 4 * MINUTE).err());
    assert_eq!(ended, [None, Some(ServiceError::SessionEvicted), None]);
    sessions.close(ids[2], begin + 4 * MINUTE).unwrap();
    let filed = sessions.idle.lock().order.len() + sessions.unused.lock().order.len();
    assert_eq!((sessions.len(), filed), (2, 2), "who has left is forgotten");
}

/// Whoever opens without end takes the places of its own like, and not those of sessions that somebody uses.
#[test]
fn who_is_not_asked_for_goes_first() {
    let (sessions, opening) = table(4);
    let begin = Instant::now();
    let used = [0, 1].map(|_| sessions.open(opening(), begin).unwrap().id);
    used.iter().for_each(|id| drop(sessions.get(*id, begin).unwrap()));
    let soon = begin + 2 * MINUTE;
    for i in 0..100 {
        let now = soon + i * Duration::from_millis(600);
        sessions.open(opening(), now).unwrap();
    }
    let now = soon + MINUTE;
    assert!(used.iter().all(|id| sessions.get(*id, now).is_ok()));
    sessions.open(opening(), now).unwrap();
    assert_eq!(sessions.open(opening(), now).err(), Some(ServiceError::Quota { retry_after_ms: 1_000 }), "none is old enough");
}

/// A refusal scanned all sessions, up to four times: 433 a second made good acts wait 226 ms. It looks at a few, and finds the idle one
/// among many that are not in a few tries.
#[test]
fn a_refusal_looks_at_a_few() {
    let (sessions, opening) = table(201);
    let begin = Instant::now();
    let ids: Vec<Uuid> = (0..201).map(|_| sessions.open(opening(), begin).unwrap().id).collect();
    ids.iter().for_each(|id| drop(sessions.get(*id, begin).unwrap()));
    let mut order: Vec<Uuid> = ids.clone();
    order.sort_by_key(|id| Handle::of(*id));
    // The last that will be looked at is the only idle one.
    let (idle, hot) = order.split_last().unwrap();
    for id in hot {
        sessions.get(*id, begin + MINUTE).unwrap();
    }
    let now = begin + MINUTE + MINUTE / 2;
    let mut refused = 0;
    while sessions.open(opening(), now).is_err() {
        refused += 1;
    }
    assert_eq!(refused, 200 / LOOKS_MAX);
    assert_eq!(sessions.get(*idle, now).err(), Some(ServiceError::SessionEvicted));
    assert!(sessions.open(opening(), now).is_err());
    assert!(sessions.idle.lock().first(MINUTE, now).is_none(), "and then none is looked at");
}

/// One that is opened while another one wants its place, and that nobody asks for then, held that place for as long as it lived.
#[test]
fn who_was_in_hand_gives_its_place_later() {
    let (_, opening) = table(1);
    let dir = tempfile::tempdir().unwrap();
    let options = Options { durability: Durability::Process, cache_bytes: 1 << 20, len_max: 10, bytes_max: 1 << 30 };
    let store = Store::by_hand(Arc::new(Embedded::open(dir.path(), options).unwrap()), 10);
    let sessions = Sessions::new(SessionsConfig { len_max: 1, ..SessionsConfig::default() }, Some(Arc::new(store)));
    let (begin, soon) = (Instant::now(), Instant::now() + MINUTE);
    let in_hand = sessions.open(opening(), begin).unwrap();
    let also = in_hand.clone();
    assert!(matches!(sessions.open(opening(), soon), Err(ServiceError::Quota { .. })), "it is about to be told");
    drop((in_hand, also));
    assert!(sessions.open(opening(), soon + MINUTE).is_ok());
    assert_eq!(sessions.len(), 1);
}
