//! Acts that are written down while they happen, and replayed: on other threads and batches, after a kill, in part; and what is not as it was is named.

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
            format::{self, Answered, Entry, Seen},
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
        config.engine.batch_len_max = 8;
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
        assert!(ask(server, &slow, observation(4, step), step, Some(60)).await.degraded);
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

/// What does not fit into the queue is left out and counted, and acts do not wait for it. The recording says that it lacks something, and no difference comes of
/// that: sessions are written down anew before they go on.
#[tokio::test(flavor = "multi_thread")]
async fn what_was_left_out_is_a_gap_and_no_difference() {
    let (server, dir) = recording(|config| config.record.queue_len_max = 1).await;
    let ids = open_many(&server, 10).await;
    act_together(&server, &ids, 1..=6).await;
    for step in 7..=8 {
        for (seed, id) in ids.iter().enumerate() {
            ask(&server, id, observation(seed, step), step, None).await;
        }
        tokio::time::sleep(Duration::from_millis(60)).await;
    }
    end(server).await;
    let report = equal(&files(dir.path())[0], 2, 4);
    assert!(report.lost > 10 && report.acts > 5, "{report}");
    assert_eq!(report.acts + report.lost, 80, "{report}");
}

/// Entries that are missing in the middle, or damaged, cost what comes after them of their session, and nothing else.
#[tokio::test(flavor = "multi_thread")]
async fn missing_and_damaged_entries_are_no_difference() {
    let (server, dir) = recording(|_| {}).await;
    act_together(&server, &open_many(&server, 2).await, 1..=4).await;
    end(server).await;
    let file = files(dir.path()).remove(0);
    let mut kept = entries(&file);
    let second = kept.iter().position(|entry| matches!(entry, Entry::Act(act) if act.step == 2)).unwrap();
    kept.remove(second);
    let report = on(&[written(dir.path(), &file, &kept)], 1, 1);
    assert_eq!((report.verdict, report.equal, report.different), (Verdict::Incomplete, 5, 0), "{report}");
    assert_eq!(report.files[0].not_compared, [(Why::Gap, 2)].into());
    // A bit of a body; then one of a length, after which nothing can be found.
    let bytes = fs::read(&file).unwrap();
    let (_, from) = offsets(&bytes)[second + 1];
    for (at, broken) in [(from + format::HEAD_LEN + 5, false), (from + 1, true)] {
        let mut flipped = bytes.clone();
        flipped[at] ^= 16;
        fs::write(dir.path().join("flipped.adar"), flipped).unwrap();
        let report = on(&[dir.path().join("flipped.adar")], 1, 1);
        let found = &report.files[0];
        assert_eq!((report.verdict, report.different, found.damaged, found.broken), (Verdict::Incomplete, 0, u64::from(!broken), broken));
        assert_eq!(report.equal, if broken { 2 } else { 5 }, "{report}");
    }
    let done = replayed(all_models(), &["--json"], &dir.path().join("flipped.adar"));
    assert_eq!(done.status.code(), Some(3), "{done:?}");
}

/// Where each entry begins: (index, byte).
fn offsets(bytes: &[u8]) -> Vec<(usize, usize)> {
    let (mut at, mut found) = (5, Vec::new());
    while let Some(head) = bytes[at..].first_chunk() {
        found.push((found.len(), at));
        at += format::HEAD_LEN + format::read_head(*head).unwrap().0;
    }
    found
}

/// A file that ends anywhere, as one does whose process was killed, is good up to there.
#[tokio::test(flavor = "multi_thread")]
async fn a_cut_file_is_good_up_to_there() {
    let (server, dir) = recording(|_| {}).await;
    act_together(&server, &open_many(&server, 1).await, 1..=2).await;
    end(server).await;
    let (file, cut) = (files(dir.path()).remove(0), dir.path().join("cut.adar"));
    let bytes = fs::read(&file).unwrap();
    let begins: Vec<_> = offsets(&bytes).into_iter().map(|(_, at)| at).collect();
    for len in (begins[1]..bytes.len()).step_by(7).chain(begins.iter().skip(1).copied()) {
        fs::write(&cut, &bytes[..len]).unwrap();
        let report = on(std::slice::from_ref(&cut), 1, 1);
        let (found, whole) = (&report.files[0], begins.contains(&len));
        assert_eq!((found.cut, found.damaged, found.broken, found.equal == found.acts), (!whole, 0, false, true), "{len}: {report}");
    }
    for (bytes, says) in [(&b""[..], "is no recording"), (b"ADAS\x01 something else", "is no recording"), (&bytes[..20], "is damaged")] {
        fs::write(&cut, bytes).unwrap();
        let done = replayed(all_models(), &[], &cut);
        let told = String::from_utf8(done.stderr).unwrap();
        assert!(done.status.code() == Some(2) && told.contains("cut.adar: ") && told.contains(says), "{told}");
    }
    let newer = [&bytes[..4], &[format::VERSION + 1], &bytes[5..]].concat();
    fs::write(&cut, newer).unwrap();
    let told = String::from_utf8(replayed(all_models(), &[], &cut).stderr).unwrap();
    assert!(told.contains(&format!("is of format {}, and this server reads", format::VERSION + 1)), "{told}");
}

/// Each file replays by itself, and there are no more bytes of them than are wanted.
#[tokio::test(flavor = "multi_thread")]
async fn each_file_of_a_rotation_replays_alone() {
    let (server, dir) = recording(|config| (config.record.file_bytes_max, config.record.dir_bytes_max) = (20_000, 1 << 30)).await;
    let ids = open_many(&server, 4).await;
    for step in 1..=40 {
        act_together(&server, &ids, step..=step).await;
        // A file turns when it is found to be full.
        tokio::time::sleep(Duration::from_millis(if step % 8 == 0 { 60 } else { 0 })).await;
    }
    end(server).await;
    let all = files(dir.path());
    assert!(all.len() >= 4, "{all:?}");
    let acts: u64 = all.iter().map(|file| equal(file, 1, 4).acts).sum();
    assert_eq!(acts, 160, "none is lost in a turn, none is there twice");
    let (server, few) = recording(|config| (config.record.file_bytes_max, config.record.dir_bytes_max) = (20_000, 60_000)).await;
    let ids = open_many(&server, 4).await;
    for step in 1..=80 {
        act_together(&server, &ids, step..=step).await;
        tokio::time::sleep(Duration::from_millis(if step % 8 == 0 { 60 } else { 0 })).await;
    }
    end(server).await;
    let kept = files(few.path());
    let bytes: u64 = kept.iter().map(|file| file.metadata().unwrap().len()).sum();
    // The last one may be longer than it should by what was on its way.
    assert!(bytes < 90_000 && kept.len() >= 2, "{bytes} bytes of {kept:?}");
    let last =
        entries(kept.last().unwrap()).into_iter().rev().find_map(|entry| if let Entry::Act(act) = entry { Some(act.step) } else { None });
    assert_eq!(last, Some(80), "the oldest went");
}

/// What may not be shown is not there, in whatever form: no number that was seen, told or answered, and no id of a session, which is a right to it.
#[tokio::test(flavor = "multi_thread")]
async fn withheld_observations_are_not_there() {
    let secret = 0.123_456_79_f32;
    let mut sizes = Vec::new();
    for observations in [true, false] {
        let (server, dir) = recording(|config| config.record.observations = observations).await;
        let (id, mut numbers) = (open(&server, "tiny", 8, pb::SamplerOptions::default()).await, vec![secret]);
        let mut agent = server.agent().await;
        for step in 1..=3 {
            let seen = pb::Observation { state: vec![secret, 0.2, 0.3, 0.4], ..Default::default() };
            numbers.extend(ask(&server, &id, seen, step, None).await.actions.unwrap().values);
        }
        // A fork stands with a past, which is as private.
        let fork = pb::ForkSessionRequest { session_id: id.clone(), ..Default::default() };
        let fork = agent.fork_session(fork).await.unwrap().into_inner().session.unwrap().session_id;
        ask(&server, &fork, observation(1, 4), 4, None).await;
        end(server).await;
        let file = files(dir.path()).remove(0);
        let bytes = fs::read(&file).unwrap();
        let is_there = |needle: &[u8]| bytes.windows(needle.len()).any(|window| window == needle);
        let shown = numbers.iter().filter(|number| is_there(&number.to_be_bytes())).count();
        assert_eq!(shown, if observations { numbers.len() } else { 0 });
        for id in [&id, &fork] {
            let raw = id.replace('-', "");
            let raw: Vec<u8> = (0..16).map(|i| u8::from_str_radix(&raw[2 * i..2 * i + 2], 16).unwrap()).collect();
            assert!(!is_there(id.as_bytes()) && !is_there(&raw));
        }
        sizes.push(bytes.len());
        if observations {
            continue;
        }
        let report = on(std::slice::from_ref(&file), 1, 1);
        assert_eq!((report.verdict, report.acts, report.equal), (Verdict::Incomplete, 4, 0));
        assert_eq!(report.files[0].not_compared, [(Why::Withheld, 4)].into());
        let acts: Vec<_> =
            entries(&file).into_iter().filter_map(|entry| if let Entry::Act(act) = entry { Some(act) } else { None }).collect();
        let (Seen::Shape(first), Seen::Shape(second)) = (&acts[0].seen, &acts[1].seen) else { panic!() };
        assert_eq!((first.state_len, first.executed_len, &first.digest), (4, 0, &second.digest), "the same was seen");
        let (Answered::Outline(first), Answered::Outline(second)) = (&acts[0].answer, &acts[1].answer) else { panic!() };
        assert!(first.digest != second.digest && first.evaluations > 0 && acts[0].timings.total_us > 0);
        let done = replayed(all_models(), &[], &file);
        let text = String::from_utf8(done.stdout).unwrap();
        assert!(done.status.code() == Some(3) && text.contains("observations are withheld: it cannot be replayed"), "{text}");
    }
    assert!(sizes[1] < sizes[0], "{sizes:?}");
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

/// Killed as hard as it can be, a server leaves a recording of what went before; the next one goes on with sessions of the store, and its recording begins
/// with each as it stood.
#[tokio::test(flavor = "multi_thread")]
async fn a_killed_server_leaves_a_recording() {
    let (store, dirs) = (tempfile::tempdir().unwrap(), [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()]);
    let mut id = String::new();
    for (turn, dir) in dirs.iter().enumerate() {
        let settings = [format!("store.dir={}", store.path().display()), format!("record.dir={}", dir.path().display())];
        let (process, server) = start_process(&settings.each_ref().map(String::as_str)).await;
        if turn == 0 {
            id = open(&server, "tiny", 9, pb::SamplerOptions::default()).await;
        }
        for step in 1..=3 {
            let step = 3 * turn as u64 + step;
            ask(&server, &id, observation(1, step), step, None).await;
        }
        tokio::time::sleep(Duration::from_millis(200)).await;
        assert_eq!(server.metric("ada_record_entries_total").await, 3.0);
        assert!(server.metric("ada_record_bytes_total").await > 500.0);
        drop(process);
        let report = equal(&files(dir.path())[0], 1, 1);
        assert_eq!((report.acts, report.sessions), (3, 1));
        let Entry::Stands(stands) = &entries(&files(dir.path())[0])[0] else { panic!() };
        assert_eq!((stands.step, stands.record.is_some()), (3 * turn as u64, turn == 1));
    }
}

/// A file that cannot grow any more, as on a full disk: recording stops, says so, and goes on by itself; acts do not notice; and what was written can be
/// replayed.
#[tokio::test(flavor = "multi_thread")]
async fn a_full_disk_stops_the_recording_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let record = format!("record.dir={}", dir.path().display());
    let plain = binary(&[&record]);
    let mut command = Command::new("sh");
    // 80 KiB a file; the signal that would end the process is ignored, and the write fails.
    command.args(["-c", "trap '' XFSZ; ulimit -f 160; exec \"$0\" \"$@\""]).arg(plain.get_program()).args(plain.get_args());
    for (name, value) in plain.get_envs() {
        match value {
            Some(value) => command.env(name, value),
            None => command.env_remove(name),
        };
    }
    let (_process, server) = start_command(command).await;
    let ids = open_many(&server, 8).await;
    let mut steps = 0;
    while server.metric("ada_record_stopped").await == 0.0 {
        assert!(steps < 400, "it never stopped");
        act_together(&server, &ids, steps + 1..=steps + 10).await;
        steps += 10;
    }
    act_together(&server, &ids, steps + 1..=steps + 5).await;
    assert_eq!(server.get("/readyz").await.status, 200);
    let goes_on = async {
        while server.metric("ada_record_stopped").await == 1.0 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(Duration::from_secs(10), goes_on).await.expect("it goes on when there is room");
    act_together(&server, &ids, steps + 6..=steps + 7).await;
    tokio::time::sleep(Duration::from_millis(200)).await;
    let dropped = server.metric("ada_record_dropped_total").await as u64;
    let files = files(dir.path());
    let reports: Vec<_> = files.iter().map(|file| equal(file, 2, 8)).collect();
    assert!(files.len() == 2 && dropped >= 40 && reports[1].lost == dropped, "{files:?} {dropped} {reports:?}");
    assert_eq!(reports.iter().map(|report| report.acts).sum::<u64>() + dropped, 8 * (steps + 7));
    assert!(!reports[0].cut, "what was written of an entry was taken back");
}

/// Nothing is recorded where that is not wanted; where it is, and cannot be, the server says so before it serves.
#[tokio::test(flavor = "multi_thread")]
async fn a_directory_that_cannot_be_written_is_told_at_the_start() {
    let file = tempfile::NamedTempFile::new().unwrap();
    for dir in [file.path().to_owned(), file.path().join("below")] {
        let done = binary(&["server.listen=127.0.0.1:0"]).arg("--record").arg(&dir).output().unwrap();
        let told = String::from_utf8(done.stderr).unwrap();
        assert!(!done.status.success() && told.contains(&format!("error: record.dir {}: ", dir.display())), "{told}");
    }
    let bad = binary(&["record.dir_bytes_max=100"]).output().unwrap();
    assert!(String::from_utf8(bad.stderr).unwrap().contains("record.dir_bytes_max: must be at least twice record.file_bytes_max"));
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
        assert!(report.verdict == Verdict::Equal && report.acts >= 30 && report.files[0].degraded > 0, "version {version}: {report}");
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
    let (new, hurried) = (open(&server, "tiny", 11, Default::default()).await, Some(20));
    for step in 1..=3 {
        ask(&server, &ids[1], observation(1, step), step, None).await;
        ask(&server, &fork, observation(2, step), step + 4, None).await;
        ask(&server, &new, observation(2, step), step, hurried.filter(|_| step > 1)).await;
    }
    end(server).await;
    let kept = Path::new(KEPT).join(format!("v{}.adar", format::VERSION));
    assert!(!kept.exists(), "it is there: a recording that was kept is never written anew");
    fs::create_dir_all(KEPT).unwrap();
    fs::copy(&files(dir.path())[0], kept).unwrap();
}
