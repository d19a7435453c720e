//! Acts that are written down while they happen, and replayed: on other threads and batches, after a kill, in part; and what is not as it was is named.

mod ends;
mod parts;

use super::{
    bytes::observation,
    methods::{fresh, oracle},
    *,
};
use ada_diffuser::{
    model::method::{Guide, TrueFuture},
    model::normalizer::Affine,
    serve::{
        recording::{
            Piece, Recording,
            format::{self, Answered, Entry},
        },
        replay::{FileReport, Plan, Report, Verdict, Why, replay},
    },
};
use std::process::Output;

/// `tiny`, `slow`, `guided` (by what its decoder says of the return) and `oracle` (told the true context).
fn all_models() -> &'static Path {
    static DIR: OnceLock<tempfile::TempDir> = OnceLock::new();
    DIR.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        let guided = fresh(|config| {
            config.method.guide = Some(Guide::DecoderReturn);
            config.units.returns = Some(Affine { mean: vec![-2.0], std: vec![0.5] });
        });
        let oracle = oracle(TrueFuture::Known);
        let (tiny, slow) = (models_dir().join("tiny"), models_dir().join("slow"));
        for (from, name) in
            [(tiny, "tiny"), (slow, "slow"), (guided.path().join("fresh"), "guided"), (oracle.path().join("fresh"), "oracle")]
        {
            copy(&from, &dir.path().join(name));
        }
        dir
    })
    .path()
}

/// A server over these models that records, and where.
async fn recording(adjust: impl FnOnce(&mut Config)) -> (Running, tempfile::TempDir) {
    let dir = tempfile::tempdir().unwrap();
    let server = start(|config| {
        config.models.dir = all_models().to_owned();
        // Of the time that a hurried act has, half is kept: a busy machine is no reason to be late.
        (config.engine.batch_len_max, config.engine.deadline_margin_ms) = (8, 150);
        config.record.dir = dir.path().to_owned();
        adjust(config);
    })
    .await;
    (server, dir)
}

/// Ends it, so that all is written.
async fn end(mut server: Running) {
    server.stop.cancel();
    timeout(Duration::from_secs(10), &mut server.done).await.expect("it did not end").unwrap().unwrap();
}

/// Recordings in a directory, oldest first.
fn files(dir: &Path) -> Vec<PathBuf> {
    let mut files: Vec<_> = fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

fn on(files: &[PathBuf], workers: usize, batch: usize) -> Report {
    replay(&Plan { files: files.to_vec(), models: all_models().to_owned(), workers, batch }, |_, _| ()).unwrap()
}

/// One file that is all equal.
fn equal(file: &Path, workers: usize, batch: usize) -> FileReport {
    let report = on(&[file.to_owned()], workers, batch);
    assert_eq!((report.verdict, report.equal), (Verdict::Equal, report.acts), "{report}");
    report.files.into_iter().next().unwrap()
}

fn entries(file: &Path) -> Vec<Entry> {
    let pieces = Recording::open(file).unwrap();
    pieces.map(|piece| if let Piece::Entry(entry) = piece { entry } else { panic!("{piece:?}") }).collect()
}

/// A recording of these entries, with the header of another one.
fn written(dir: &Path, of: &Path, entries: &[Entry]) -> PathBuf {
    let mut bytes = [&format::MAGIC[..], &[format::VERSION]].concat();
    format::write(&Entry::Header(Recording::open(of).unwrap().header().clone()), &mut bytes).unwrap();
    entries.iter().for_each(|entry| format::write(entry, &mut bytes).unwrap());
    let path = dir.join("changed.adar");
    fs::write(&path, bytes).unwrap();
    path
}

/// `ada-server replay` with these words.
fn replayed(models: &Path, words: &[&str], file: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ada-server"));
    command.args(["replay", "--models"]).arg(models).args(words).arg(file).output().unwrap()
}

async fn open(server: &Running, model: &str, seed: u64, options: pb::SamplerOptions) -> String {
    let request = pb::OpenSessionRequest { model: model.into(), seed: Some(seed), options: Some(options), ..Default::default() };
    server.agent().await.open_session(request).await.unwrap().into_inner().session.unwrap().session_id
}

async fn ask(server: &Running, id: &str, observation: pb::Observation, step: u64, deadline_ms: Option<u32>) -> pb::ActResponse {
    let request = pb::ActRequest { session_id: id.into(), step, observation: Some(observation), deadline_ms, ..Default::default() };
    server.agent().await.act(request).await.unwrap().into_inner()
}

/// So many acts of sessions of seeds 0 to 9, together in batches, with all that may be told of what was executed.
async fn act_together(server: &Running, ids: &[String], steps: std::ops::RangeInclusive<u64>) {
    for step in steps {
        let act = |(seed, id): (usize, &String)| pb::ActRequest {
            session_id: id.clone(),
            step,
            observation: Some(observation(seed, step)),
            ..Default::default()
        };
        let acts = ids.iter().enumerate().map(act).collect();
        for result in server.agent().await.act_batch(pb::ActBatchRequest { acts }).await.unwrap().into_inner().results {
            assert!(matches!(result.result, Some(pb::act_result::Result::Response(_))), "{result:?}");
        }
    }
}

async fn open_many(server: &Running, count: u64) -> Vec<String> {
    let mut ids = Vec::new();
    for seed in 0..count {
        let latent = Some(pb::LatentMode::Sample as i32);
        let (horizon, at_once) = (Some(1 + seed as u32 % 2), Some(1 + seed as u32 % 3));
        let noisy = pb::SamplerOptions { eta: Some(0.7), temperature: Some(1.0), latent, ..Default::default() };
        ids.push(open(server, "tiny", seed, pb::SamplerOptions { action_horizon: horizon, picard_window: at_once, ..noisy }).await);
    }
    ids
}

/// Everything there is: latents that are drawn, chunks, rows at once, steps told of, a guide and candidates, an oracle, resets with and without a new seed,
/// forks, imports, acts that a deadline degraded, and acts that were sent twice. Returns how many acts were committed.
async fn live(server: &Running) -> u64 {
    let many = open_many(server, 10).await;
    act_together(server, &many, 1..=4).await;
    let guided = pb::SamplerOptions {
        guidance_scale: Some(0.5),
        candidates: Some(4),
        pick_temperature: Some(0.5),
        streaming: Some(false),
        latent: Some(pb::LatentMode::Sample as i32),
        ..Default::default()
    };
    let (led, oracle) = (open(server, "guided", 3, guided).await, open(server, "oracle", 4, pb::SamplerOptions::default()).await);
    let context = |step: u64| pb::Matrix { values: vec![0.5, -0.5 * step as f32, 1.0, 0.25], rows: 2, columns: 2 };
    for step in 1..=3 {
        assert!(ask(server, &led, observation(1, step), step, None).await.value.is_some());
        let seen = pb::Observation { context: Some(context(step)), ..observation(2, step) };
        ask(server, &oracle, seen, step, None).await;
    }
    let mut agent = server.agent().await;
    for (seed, at) in [(Some(77), 4), (None, 2)] {
        let reset = pb::ResetSessionRequest { session_id: many[0].clone(), seed, ..Default::default() };
        agent.reset_session(reset).await.unwrap();
        for step in 1..=at {
            ask(server, &many[0], observation(3, step), step, None).await;
        }
    }
    let fork = pb::ForkSessionRequest { session_id: many[1].clone(), seed: Some(5), ..Default::default() };
    let fork = agent.fork_session(fork).await.unwrap().into_inner().session.unwrap().session_id;
    let record = agent.export_session(pb::ExportSessionRequest { session_id: many[2].clone() }).await.unwrap().into_inner().record;
    let import = pb::ImportSessionRequest { record, ..Default::default() };
    let import = agent.import_session(import).await.unwrap().into_inner().session.unwrap().session_id;
    for (seed, id) in [(1, &fork), (2, &import)] {
        for step in 5..=6 {
            ask(server, id, observation(seed, step), step, None).await;
            assert!(ask(server, id, observation(seed, step), step, None).await.replayed);
        }
    }
    let slow = open(server, "slow", 6, pb::SamplerOptions { eta: Some(0.7), ..Default::default() }).await;
    for step in 1..=4 {
        assert!(ask(server, &slow, observation(4, step), step, Some(300)).await.degraded);
    }
    10 * 4 + 2 * 3 + 4 + 2 + 2 * 2 + 4
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recording_replays_on_other_threads_and_batches() {
    let (server, dir) = recording(|_| {}).await;
    let acts = live(&server).await;
    end(server).await;
    let files = files(dir.path());
    assert_eq!(files.len(), 1);
    for (workers, batch) in [(1, 1), (3, 5), (2, 64)] {
        let report = equal(&files[0], workers, batch);
        assert_eq!((report.acts, report.sessions, report.degraded, report.resets), (acts, 15, 4, 2));
        assert_eq!((report.lost, report.damaged, report.cut, report.broken), (0, 0, false, false));
    }
    // Of a fork and an import there are bytes, of a new session its seed and options.
    let stands = entries(&files[0]).into_iter().filter_map(|entry| if let Entry::Stands(stands) = entry { Some(stands) } else { None });
    let taken_up: Vec<_> = stands.filter(|stands| stands.record.is_some()).map(|stands| (stands.step, stands.seed)).collect();
    assert_eq!(taken_up, [(4, 5), (4, 2)]);
    // As a user does it.
    let done = replayed(all_models(), &["--workers", "1", "--batch", "3", "--json"], &files[0]);
    assert_eq!(done.status.code(), Some(0), "{done:?}");
    let report: Value = serde_json::from_slice(&done.stdout).unwrap();
    assert_eq!((&report["verdict"], &report["equal"], &report["files"][0]["degraded"]), (&json!("equal"), &json!(acts), &json!(4)));
    let done = replayed(all_models(), &[], &files[0]);
    let text = String::from_utf8(done.stdout).unwrap();
    assert!(text.ends_with('\n') && text.contains(&format!("equal: all {acts} acts, bit for bit")), "{text}");
}

/// A single bit of a single number: its session, episode, step and place are named, with both values; the sessions beside it are compared all the same.
#[tokio::test(flavor = "multi_thread")]
async fn a_changed_byte_of_an_answer_is_found_and_named() {
    let (server, dir) = recording(|_| {}).await;
    act_together(&server, &open_many(&server, 3).await, 1..=3).await;
    end(server).await;
    let file = files(dir.path()).remove(0);
    let mut entries = entries(&file);
    let act = entries.iter_mut().filter_map(|entry| if let Entry::Act(act) = entry { Some(act) } else { None }).find(|act| act.step == 2);
    let act = act.unwrap();
    let Answered::Answer(answer) = &mut act.answer else { panic!() };
    let was = answer.actions[0][1];
    answer.actions[0][1] = f32::from_bits(was.to_bits() ^ 1);
    let (changed, session) = (written(dir.path(), &file, &entries), act_name(&entries));
    let report = on(std::slice::from_ref(&changed), 2, 4);
    assert_eq!((report.verdict, report.acts, report.equal, report.different), (Verdict::Different, 9, 7, 1), "{report}");
    let first = report.files[0].first.clone().unwrap();
    assert_eq!((first.session.to_string(), first.episode, first.step, first.field.as_str()), (session.clone(), 0, 2, "actions[0][1]"));
    assert!(first.found.starts_with(&format!("{was:?} (0x")) && first.expected != first.found, "{first}");
    assert_eq!(report.files[0].not_compared, [(Why::AfterDifference, 1)].into());
    let done = replayed(all_models(), &[], &changed);
    let text = String::from_utf8(done.stdout).unwrap();
    assert_eq!(done.status.code(), Some(1));
    assert!(text.contains(&format!("session {session}, episode 0, step 2: actions[0][1] was ")), "{text}");
}

/// The session whose second step comes first.
fn act_name(entries: &[Entry]) -> String {
    let second = |entry: &Entry| if let Entry::Act(act) = entry { (act.step == 2).then(|| act.session.to_string()) } else { None };
    entries.iter().find_map(second).unwrap()
}

/// A session of weights that are not here is counted, and named; under another name they will do.
#[tokio::test(flavor = "multi_thread")]
async fn a_model_that_is_not_here_is_named() {
    let (server, dir) = recording(|_| {}).await;
    ask(&server, &open(&server, "tiny", 1, pb::SamplerOptions::default()).await, observation(1, 1), 1, None).await;
    ask(&server, &open(&server, "guided", 1, pb::SamplerOptions::default()).await, observation(1, 1), 1, None).await;
    end(server).await;
    let (file, models) = (files(dir.path()).remove(0), tempfile::tempdir().unwrap());
    copy(&all_models().join("tiny"), &models.path().join("renamed"));
    let done = replayed(models.path(), &["--json"], &file);
    let report: Value = serde_json::from_slice(&done.stdout).unwrap();
    assert_eq!((done.status.code(), &report["verdict"], &report["equal"]), (Some(3), &json!("incomplete"), &json!(1)), "{report}");
    assert_eq!(report["files"][0]["not_compared"], json!({"no_model": 1}));
    assert!(report["files"][0]["missing_models"][0].as_str().unwrap().starts_with("guided@"), "{report}");
    let done = replayed(&models.path().join("nowhere"), &[], &file);
    assert_eq!(done.status.code(), Some(2), "{done:?}");
}

/// Lines that other programs read: every entry, with numbers that are exact as 32-bit floats.
#[tokio::test(flavor = "multi_thread")]
async fn an_export_holds_every_entry() {
    let (server, dir) = recording(|_| {}).await;
    let id = open(&server, "tiny", 8, pb::SamplerOptions { kappa: Some(f32::INFINITY), ..Default::default() }).await;
    let answer = ask(&server, &id, observation(3, 1), 1, None).await;
    end(server).await;
    let file = files(dir.path()).remove(0);
    let done = replayed(all_models(), &["--export"], &file);
    let lines: Vec<Value> = String::from_utf8(done.stdout).unwrap().lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!((done.status.code(), lines.len()), (Some(0), 4), "{lines:?}");
    assert_eq!((&lines[0]["header"]["observations"], &lines[1]["stands"]["seed"]), (&json!(true), &json!(8)));
    assert_eq!((&lines[1]["stands"]["options"]["kappa"], &lines[1]["stands"]["record"]), (&json!("infinity"), &Value::Null));
    let actions = lines[2]["act"]["answer"]["answer"]["actions"].clone();
    let actions: Vec<f32> = serde_json::from_value::<Vec<Vec<f32>>>(actions).unwrap().concat();
    assert_eq!(actions, answer.actions.unwrap().values);
    assert_eq!(lines[3], json!({"end": {"is": "whole", "damaged_entries": 0}}));
}

const KEPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/recordings");

/// Recordings of every version there was, on `models/tiny`: a reader that cannot replay one of them has broken what its users keep.
#[test]
fn recordings_of_every_version_replay() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    for version in format::VERSION_MIN..=format::VERSION {
        let file = Path::new(KEPT).join(format!("v{version}.adar"));
        let report = replay(&Plan { files: vec![file], models: models.clone(), workers: 2, batch: 4 }, |_, _| ()).unwrap();
        assert!(report.verdict == Verdict::Equal && report.acts >= 30 && report.files[0].degraded > 1, "version {version}: {report}");
    }
}

/// Writes the one of this version: `cargo test --release --test it -- --ignored keep_a_recording`. One that is there stays as it is.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "writes tests/golden/recordings"]
async fn keep_a_recording_of_this_version() {
    let (server, dir) = recording(|config| {
        config.models.dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
        config.engine.deadline_margin_ms = 20;
    })
    .await;
    let ids = open_many(&server, 5).await;
    act_together(&server, &ids, 1..=4).await;
    let mut agent = server.agent().await;
    let reset = pb::ResetSessionRequest { session_id: ids[1].clone(), seed: Some(7), ..Default::default() };
    agent.reset_session(reset).await.unwrap();
    let fork = pb::ForkSessionRequest { session_id: ids[2].clone(), seed: Some(5), ..Default::default() };
    let fork = agent.fork_session(fork).await.unwrap().into_inner().session.unwrap().session_id;
    // In no time at all a window that is there is given out as it is, and one that is not takes a single jump.
    let cold = pb::SamplerOptions { streaming: Some(false), ..Default::default() };
    let (new, cold) = (open(&server, "tiny", 11, Default::default()).await, open(&server, "tiny", 12, cold).await);
    for step in 1..=4 {
        ask(&server, &ids[1], observation(1, step), step, None).await;
        ask(&server, &fork, observation(2, step), step + 4, None).await;
        for id in [&new, &cold] {
            ask(&server, id, observation(2, step), step, Some(20).filter(|_| step > 1)).await;
        }
    }
    end(server).await;
    let kept = Path::new(KEPT).join(format!("v{}.adar", format::VERSION));
    assert!(!kept.exists(), "it is there: a recording that was kept is never written anew");
    fs::create_dir_all(KEPT).unwrap();
    fs::copy(&files(dir.path())[0], kept).unwrap();
}
