//! Sessions whose store is ahead of memory.

use super::*;
use crate::{
    model::agent::Observation,
    serve::{
        config::ModelsConfig,
        engine::Patience,
        session::{Answer, Entry, Standing, Timings, key_of},
    },
};
use std::path::{Path, PathBuf};

const LONG: Duration = Duration::from_secs(60);

fn seen() -> Observation {
    Observation { state: vec![0.1; 4], ..Observation::default() }
}

fn models() -> (tempfile::TempDir, Registry) {
    let dir = tempfile::tempdir().unwrap();
    let tiny = dir.path().join("tiny");
    std::fs::create_dir(&tiny).unwrap();
    for file in Path::new("models/tiny").read_dir().unwrap().map(Result::unwrap) {
        std::fs::copy(file.path(), tiny.join(file.file_name())).unwrap();
    }
    let config = ModelsConfig { dir: dir.path().to_owned(), default: "tiny".into(), ..ModelsConfig::default() };
    (dir, Registry::load(&config).unwrap())
}

fn keeper(dir: PathBuf) -> Keeper {
    Keeper::open_store(&SessionsConfig::default(), &StoreConfig { dir, ..StoreConfig::default() }).unwrap()
}

fn opening(registry: &Registry, ttl: Duration) -> Opening {
    let model = registry.get("").unwrap();
    let episode = model.agent.open(1, &model.agent.spec().sampler).unwrap();
    Opening {
        model: model.name.clone(),
        agent: model.agent.clone(),
        episode: Arc::new(episode),
        standing: Standing::default(),
        ttl,
        request_id: String::new(),
        known: None,
    }
}

/// The write of the session's next commit, which is not made.
fn next(session: &Arc<Session>) -> Write {
    let (episode, standing) = session.standing((None, None)).unwrap();
    let Ok(Entry::Lead(waiter, _)) = session.enter((None, standing.step + 1), key_of(&seen()), Instant::now(), Patience::default()) else {
        panic!("it is the next")
    };
    let (after, chunk) = session.agent.act(&episode, &seen()).unwrap();
    let answer = Answer {
        session: session.id,
        step: standing.step + 1,
        chunk: Arc::new(chunk),
        timings: Timings::default(),
        model: session.model.clone(),
        model_digest: String::new(),
    };
    let write = session.about_to_commit(waiter.flight(), &Arc::new(after), &answer).unwrap().unwrap();
    session.fail(waiter.flight(), ServiceError::SessionNotFound);
    write
}

/// A commit that was kept and seemed to fail: memory stands one step behind, its next commit is refused, and after that it is as it is kept.
#[tokio::test]
async fn memory_that_is_behind_is_found_out() {
    let (_models, registry) = models();
    let dir = tempfile::tempdir().unwrap();
    let keeper = keeper(dir.path().to_owned());
    let (session, _untold) = keeper.open(opening(&registry, LONG), &registry).await.unwrap();
    let kept = next(&session);
    assert_eq!(keeper.keep(kept.clone(), |_| ()).await, Ok(Ok(())), "nobody told the session");
    assert_eq!(keeper.keep(next(&session), |_| ()).await, Ok(Err(Refused::Conflict)));
    session.overtaken(Refused::Conflict);
    // Whoever found it before that is not told that there is none.
    let late = [
        session.standing((None, None)).err(),
        session.begin_reset(Renewal { seed: 1, keep_history: false }, None, String::new(), Instant::now()).err(),
    ];
    assert_eq!(late.map(|error| error.unwrap().reason()), ["STORE_UNAVAILABLE"; 2]);
    let again = keeper.find(session.id, &registry).await.unwrap();
    assert_eq!(again.summary(Instant::now()).committed_step, 1);
    assert!(again.replay((None, 1), key_of(&seen())).is_some(), "with the answer that was kept");
    assert_eq!(keeper.table().len(), 1);
    // A reset of the one that is behind finds out as well.
    assert_eq!(keeper.keep(next(&again), |_| ()).await, Ok(Ok(())));
    let renewal = Renewal { seed: 1, keep_history: false };
    let refused = keeper.reset(&again, renewal, None, String::new()).await.unwrap_err();
    assert_eq!(refused.reason(), "STORE_UNAVAILABLE");
    assert_eq!(keeper.find(session.id, &registry).await.unwrap().summary(Instant::now()).committed_step, 2);
}

/// One that went on while the search for the expired had read it is not ended.
#[tokio::test]
async fn what_went_on_does_not_expire() {
    let (_models, registry) = models();
    let dir = tempfile::tempdir().unwrap();
    let keeper = keeper(dir.path().to_owned());
    let (session, _untold) = keeper.open(opening(&registry, Duration::from_millis(1)), &registry).await.unwrap();
    let home = keeper.store().unwrap().home().clone();
    let (handle, bytes) = home.page(None, 1).unwrap().remove(0);
    let kept = read(&bytes).unwrap();
    assert_eq!(keeper.keep(next(&session), |_| ()).await, Ok(Ok(())));
    tokio::time::sleep(Duration::from_millis(20)).await;
    assert!(keeper.expire(handle, &bytes, &kept), "as it was read");
    keeper.stop();
    assert!(matches!(home.read(handle), Ok(Place::Kept(_))));
}

/// One whose caller has gone while its open was on its way into the store is undone, there too; one that has a name stays.
#[tokio::test]
async fn an_open_that_is_given_up_is_undone() {
    let (_models, registry) = models();
    let dir = tempfile::tempdir().unwrap();
    let keeper = keeper(dir.path().to_owned());
    let home = keeper.store().unwrap().home().clone();
    for (request_id, left) in [("", 0), ("mine", 1)] {
        let asked = Opening { request_id: request_id.to_owned(), ..opening(&registry, LONG) };
        let mut open = Box::pin(keeper.open(asked, &registry));
        // Until it is on its way; one that has a name is looked for first.
        while futures_util::poll!(&mut open).is_pending() && keeper.table().is_empty() {
            tokio::task::yield_now().await;
        }
        drop(open);
        let (told, written) = oneshot::channel();
        let last = Write { handle: Handle::of(Uuid::nil()), change: Change::Free { from: None, ending: None, name: None } };
        keeper.store().unwrap().submit(last, |_| told.send(()).unwrap());
        written.await.unwrap();
        assert_eq!((keeper.table().len(), home.size().unwrap().sessions), (left, left as u64), "{request_id:?}");
    }
}

/// What stands before a record is held against it: a changed one would pass for another commit, or end the session early.
#[tokio::test]
async fn a_head_is_that_of_its_record() {
    let (_models, registry) = models();
    let dir = tempfile::tempdir().unwrap();
    let keeper = keeper(dir.path().to_owned());
    let (_session, _untold) = keeper.open(opening(&registry, LONG), &registry).await.unwrap();
    let (_, bytes) = keeper.store().unwrap().home().page(None, 1).unwrap().remove(0);
    read(&bytes).unwrap();
    for place in 0..bytes.len() {
        let mut changed = bytes.clone();
        changed[place] ^= 1 << (place % 8);
        assert_eq!(read(&changed).unwrap_err().reason(), "STATE_CORRUPT", "byte {place}");
    }
}

/// A newer state from a token takes the place of what is here, with a store and without: who has an act in flight there is told to ask again. One that does not
/// fit the model costs the session nothing, and an older one is refused.
#[tokio::test]
async fn a_newer_state_takes_the_place_of_an_older_one() {
    let (_models, registry) = models();
    let dir = tempfile::tempdir().unwrap();
    for place in [dir.path().to_owned(), PathBuf::new()] {
        let keeper = keeper(place);
        let (session, _untold) = keeper.open(opening(&registry, LONG), &registry).await.unwrap();
        let Change::Keep { bytes, .. } = next(&session).change else { panic!("a commit") };
        let newer = read(&bytes).unwrap();
        let mut unfit = newer.clone();
        unfit.record.last = None;
        assert_eq!(keeper.resume(unfit, &registry).await.err().unwrap().reason(), "STATE_CORRUPT");
        let other = Observation { state: vec![0.2; 4], ..Observation::default() };
        let Ok(Entry::Lead(waiter, _)) = session.enter((None, 1), key_of(&other), Instant::now(), Patience::default()) else {
            panic!("it is here as it was")
        };
        let resumed = keeper.resume(newer.clone(), &registry).await.unwrap();
        assert_eq!(resumed.summary(Instant::now()).committed_step, 1);
        assert_eq!(waiter.outcome().await.unwrap_err().reason(), "STORE_UNAVAILABLE");
        assert!(keeper.find(session.id, &registry).await.unwrap().replay((None, 1), key_of(&seen())).is_some());
        let Change::Keep { bytes, .. } = next(&resumed).change else { panic!("a commit") };
        assert_eq!(keeper.resume(read(&bytes).unwrap(), &registry).await.unwrap().summary(Instant::now()).committed_step, 2);
        assert_eq!(keeper.resume(newer, &registry).await.err().unwrap().reason(), "TOKEN_STALE");
        assert_eq!(keeper.table().len(), 1);
    }
}
