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

fn opening(registry: &Registry) -> Opening {
    let model = registry.get("").unwrap();
    let episode = model.agent.open(1, &model.agent.spec().sampler).unwrap();
    Opening {
        model: model.name.clone(),
        agent: model.agent.clone(),
        episode: Arc::new(episode),
        standing: Standing::default(),
        ttl: Duration::from_secs(60),
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
    let session = keeper.open(opening(&registry), &registry).await.unwrap();
    let kept = next(&session);
    assert_eq!(keeper.keep(kept.clone(), |_| ()).await, Ok(Ok(())), "nobody told the session");
    assert_eq!(keeper.keep(next(&session), |_| ()).await, Ok(Err(Refused::Conflict)));
    session.overtaken(Refused::Conflict);
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
    let session = keeper.open(opening(&registry), &registry).await.unwrap();
    let home = keeper.store().unwrap().home().clone();
    let (handle, bytes) = home.page(None, 1).unwrap().remove(0);
    let kept = read(&bytes).unwrap();
    assert_eq!(keeper.keep(next(&session), |_| ()).await, Ok(Ok(())));
    keeper.expire(handle, &bytes, &kept);
    keeper.stop();
    assert!(matches!(home.read(handle), Ok(Place::Kept(_))));
}
