//! `ada-trainer` as a process: killed, interrupted, asked wrong questions.
#![allow(clippy::unwrap_used)] // what serves tests alone is a test

use std::{
    fs,
    path::Path,
    process::{Child, Command, Output, Stdio},
    thread::sleep,
    time::{Duration, Instant},
};

const TRAINER: &str = env!("CARGO_BIN_EXE_ada-trainer");
const RECIPE: &str = "tests/golden/small.toml";
const DEADLINE: Duration = Duration::from_secs(120);

fn command(out: &Path) -> Command {
    let mut command = Command::new(TRAINER);
    let sizes = ["stage1.steps=150", "stage2.steps=150", "checkpoint_every=10", "log_every=1"];
    command.args(["run", RECIPE, "--out"]).arg(out).args(sizes.iter().flat_map(|text| ["--set", text]));
    command.stdout(Stdio::null()).stderr(Stdio::null());
    command
}

fn ask(arguments: &[&str]) -> Output {
    Command::new(TRAINER).args(arguments).output().unwrap()
}

fn log_lines(out: &Path) -> usize {
    fs::read_to_string(out.join("training/log.jsonl")).map_or(0, |text| text.lines().count())
}

/// Starts a run and waits until its log has this many lines.
fn start_until(out: &Path, lines: usize) -> Child {
    let mut child = command(out).spawn().unwrap();
    let begun = Instant::now();
    while log_lines(out) < lines {
        assert!(begun.elapsed() < DEADLINE && child.try_wait().unwrap().is_none(), "the run ended or hangs at {} lines", log_lines(out));
        sleep(Duration::from_millis(2));
    }
    child
}

/// kill -9 in stage 1, twice, and in stage 2, then Ctrl-C: the checkpoint has the bytes of a run that was left alone, and so has the log.
#[test]
fn killed_and_interrupted_runs_end_in_the_same_bytes() {
    let (alone, killed) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    assert!(command(alone.path()).status().unwrap().success());
    for lines in [37, 82, 203] {
        let mut child = start_until(killed.path(), lines);
        child.kill().unwrap();
        child.wait().unwrap();
    }
    let mut child = start_until(killed.path(), 245);
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert!(!killed.path().join("training/state.partial").exists());
    assert!(command(killed.path()).status().unwrap().success());
    for file in ["model.safetensors", "config.json", "manifest.json", "training/log.jsonl"] {
        assert!(fs::read(alone.path().join(file)).unwrap() == fs::read(killed.path().join(file)).unwrap(), "{file} differs");
    }
}

#[test]
fn probe_and_inspect_say_what_a_checkpoint_is() {
    let out = tempfile::tempdir().unwrap();
    let dir = out.path().to_str().unwrap();
    assert!(ask(&["run", RECIPE, "--out", dir, "--seed", "5"]).status.success());
    let text = String::from_utf8(ask(&["inspect", dir]).stdout).unwrap();
    assert!(text.contains("digest") && text.contains("seed        5") && text.contains("[stage2]"), "{text}");
    let value: serde_json::Value = serde_json::from_slice(&ask(&["inspect", dir, "--json"]).stdout).unwrap();
    assert_eq!(value["provenance"]["seed"], 5);
    assert!(value["parameters"]["denoiser"].as_u64().unwrap() > 0);
    let scores: serde_json::Value = serde_json::from_slice(&ask(&["probe", dir, "tests/golden/data_good.h5", "--json"]).stdout).unwrap();
    let shifts: Vec<i64> = scores.as_array().unwrap().iter().take(3).map(|score| score["shift"].as_i64().unwrap()).collect();
    assert_eq!(shifts, [-1, 0, 1]);
    let table = String::from_utf8(ask(&["probe", dir, "tests/golden/data_good.h5"]).stdout).unwrap();
    assert!(table.contains("latent") && table.contains("ceiling") && table.contains("SuccessorState"), "{table}");
}

/// One line that names the key, the file or the flag, and a failing exit code; no training directory is left behind.
#[test]
fn mistakes_get_one_clear_line() {
    let out = tempfile::tempdir().unwrap();
    let dir = out.path().join("out");
    for (arguments, words) in [
        (vec!["--set", "stage2.bacth=3"], "unknown field `bacth`"),
        (vec!["--data", "tests/golden/data_nan.h5"], "NaN at row 30"),
        (vec!["--data", "nowhere.h5"], "nowhere.h5"),
        (vec!["--set", "model.level_max=3"], "`model.level_max`"),
    ] {
        let mut all = vec!["run", RECIPE, "--out", dir.to_str().unwrap()];
        all.extend(arguments);
        let output = ask(&all);
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && text.starts_with("error: ") && text.contains(words), "{text}");
        assert!(!dir.exists(), "nothing is written before the checks");
    }
    let output = ask(&["inspect", dir.to_str().unwrap()]);
    assert!(!output.status.success() && String::from_utf8(output.stderr).unwrap().contains("manifest.json"));
}
