//! A recording that lacks something: what was left out, damaged, cut, turned over to another file, or withheld.

use super::*;
use ada_diffuser::serve::recording::format::Seen;

/// An act that does not fit into the queue is left out and counted. The recording says that it lacks something, and no difference comes of that: its session
/// is written down anew before it goes on.
#[tokio::test(flavor = "multi_thread")]
async fn what_was_left_out_is_a_gap_and_no_difference() {
    let (server, dir) = recording(|config| config.record.queue_bytes_max = 200_000).await;
    let ids = open_many(&server, 4).await;
    for step in 1..=6 {
        for (seed, id) in ids.iter().enumerate() {
            // Told of so much, an act takes more room than there is.
            let long = seed < 2 && [3, 5].contains(&step);
            let told = pb::Executed { state: vector(4), action: vector(2), reward: Some(0.5) };
            let executed = if long { vec![told; 4_000] } else { vec![] };
            let seen = pb::Observation { state: vec![0.25; 4], executed, ..Default::default() };
            ask(&server, id, seen, step, None).await;
        }
    }
    end(server).await;
    let file = &files(dir.path())[0];
    let report = equal(file, 2, 4);
    assert_eq!((report.acts, report.lost, report.sessions), (20, 4, 4), "{report}");
    let anew = |entry: &Entry| if let Entry::Stands(stands) = entry { Some((stands.step, stands.lost)) } else { None };
    let anew: Vec<_> = entries(file).iter().filter_map(anew).collect();
    assert_eq!(anew, [(0, 0), (0, 0), (0, 0), (0, 0), (3, 1), (3, 1), (5, 1), (5, 1)]);
}

fn vector(len: usize) -> Option<pb::Vector> {
    Some(pb::Vector { values: vec![0.25; len] })
}

/// However many come at once: what is not in the recording is counted.
#[tokio::test(flavor = "multi_thread")]
async fn every_act_is_recorded_or_counted() {
    let (server, dir) = recording(|config| config.record.queue_len_max = 1).await;
    act_together(&server, &open_many(&server, 10).await, 1..=8).await;
    end(server).await;
    let report = equal(&files(dir.path())[0], 2, 4);
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
    // Until the last one is full: the next act begins another one, and there is none.
    let mut step = 40;
    while files(dir.path()).pop().is_some_and(|last| last.metadata().unwrap().len() < 20_000) {
        assert!(step < 200, "no file stays full: one is begun before there is something to write");
        step += 1;
        act_together(&server, &ids, step..=step).await;
        tokio::time::sleep(Duration::from_millis(60)).await;
    }
    end(server).await;
    let all = files(dir.path());
    assert!(all.len() >= 4, "{all:?}");
    let acts: u64 = all.iter().map(|file| equal(file, 1, 4).acts).sum();
    assert_eq!(acts, 4 * step, "none is lost in a turn, none is there twice");
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
    let last = entries(&kept[kept.len() - 1]);
    let mut acts = last.into_iter().filter_map(|entry| if let Entry::Act(act) = entry { Some(act.step) } else { None });
    assert_eq!(acts.next_back(), Some(80), "the oldest went");
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
