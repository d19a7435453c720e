//! A recording that comes to its end: with its server, with its disk, or before it begins.

use super::*;

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
