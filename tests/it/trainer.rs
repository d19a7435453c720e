//! `ada-trainer` as a process: killed, interrupted, asked wrong questions.
#![allow(clippy::unwrap_used)] // what serves tests alone is a test

use ada_diffuser::model::checkpoint;
use std::{
    ffi::OsStr,
    fs,
    os::unix::ffi::OsStrExt,
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
    let sizes = ["stages.identify.steps=150", "stages.denoise.steps=150", "checkpoint_every=10", "log_every=1"];
    command.args(["run", RECIPE, "--out"]).arg(out).args(sizes.iter().flat_map(|text| ["--set", text]));
    command.stdout(Stdio::null()).stderr(Stdio::null());
    command
}

fn send(signal: &str, child: &Child) {
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
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
    wait_for_lines(&mut child, out, lines);
    child
}

fn wait_for_lines(child: &mut Child, out: &Path, lines: usize) {
    let begun = Instant::now();
    while log_lines(out) < lines {
        assert!(begun.elapsed() < DEADLINE && child.try_wait().unwrap().is_none(), "the run ended or hangs at {} lines", log_lines(out));
        sleep(Duration::from_millis(2));
    }
}

/// kill -9 in the first stage, twice, and in the second, then Ctrl-C: the checkpoint has the bytes of a run that was left alone, and so has the log.
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
    send("-INT", &child);
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert!(!killed.path().join("training/state.partial").exists());
    assert!(command(killed.path()).status().unwrap().success());
    for file in ["model.safetensors", "config.json", "manifest.json", "training/log.jsonl"] {
        assert!(fs::read(alone.path().join(file)).unwrap() == fs::read(killed.path().join(file)).unwrap(), "{file} differs");
    }
}

/// Whether hangups are ignored here, as under `nohup`, and so by every child.
fn hangups_are_ignored() -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask & 1 == 1)
}

/// A shutdown (SIGTERM) or a terminal that is closed (SIGHUP) lost the steps since the last checkpoint; they are saved as by Ctrl-C. Under
/// `nohup` a hangup is nobody's signal, and the test waited for ever.
#[test]
fn every_polite_signal_saves_the_state() {
    let signals = [("-TERM", 143), ("-HUP", 129)];
    for (signal, code) in signals.into_iter().take(if hangups_are_ignored() { 1 } else { 2 }) {
        let out = tempfile::tempdir().unwrap();
        let mut command = command(out.path());
        let mut child = command.args(["--set", "checkpoint_every=100000", "--set", "stages.identify.steps=1000000"]).spawn().unwrap();
        wait_for_lines(&mut child, out.path(), 5);
        send(signal, &child);
        assert_eq!(child.wait().unwrap().code(), Some(code));
        assert!(out.path().join("training/state.safetensors").exists(), "{signal}");
    }
}

/// `nohup` has the hangup ignored, and so must a program that saves on it otherwise.
#[test]
fn nohup_is_respected() {
    let out = tempfile::tempdir().unwrap();
    let mut command = Command::new("nohup");
    command.args([TRAINER, "run", RECIPE, "--set", "stages.identify.steps=1000000", "--set", "log_every=1", "--out"]).arg(out.path());
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    wait_for_lines(&mut child, out.path(), 5);
    send("-HUP", &child);
    let lines = log_lines(out.path());
    wait_for_lines(&mut child, out.path(), lines + 20);
    send("-TERM", &child);
    assert_eq!(child.wait().unwrap().code(), Some(143));
}

/// A run writes a checkpoint at every step, and is killed a few milliseconds later each time: what is there loads at any moment, also while
/// it is replaced.
#[test]
fn kills_at_random_moments_leave_a_checkpoint_that_loads() {
    let out = tempfile::tempdir().unwrap();
    let sizes = ["stages.identify.steps=2", "stages.denoise.steps=1000000", "checkpoint_every=1", "log_every=1000000"];
    let begun = Instant::now();
    for round in 0..12_u64 {
        let mut command = Command::new(TRAINER);
        command.args(["run", RECIPE, "--out"]).arg(out.path()).args(sizes.iter().flat_map(|text| ["--set", text]));
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let manifest = || fs::read(out.path().join("manifest.json")).ok();
        let before = manifest();
        while manifest() == before {
            assert!(begun.elapsed() < DEADLINE && child.try_wait().unwrap().is_none(), "the run ended or hangs");
            sleep(Duration::from_millis(1));
        }
        for _ in 0..5 {
            checkpoint::load(out.path()).unwrap_or_else(|error| panic!("while it is replaced: {error}"));
        }
        sleep(Duration::from_millis(round * 3));
        child.kill().unwrap();
        child.wait().unwrap();
        checkpoint::load(out.path()).unwrap_or_else(|error| panic!("killed in round {round}: {error}"));
    }
}

/// Names as people have them: `--data` wrote them as a Rust string into TOML, which has other escapes, so that combining accents, joined
/// emoji and Devanagari were refused; names that are not UTF-8 ended in a panic or another file.
#[test]
fn file_names_are_taken_as_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let names = ["donne\u{301}es", "\u{921}\u{947}\u{91f}\u{93e}", "\u{2764}\u{fe0f}\u{200d}\u{1f525}", "a\u{a0}b", "q\"q", "b\\s", "a\nb"];
    let names = names.iter().map(|name| name.as_bytes()).chain([&b"latin-\xe9"[..]]);
    for name in names.map(OsStr::from_bytes) {
        let [data, out, recipe] = ["h5", "out", "toml"].map(|end| dir.path().join(name).with_extension(end));
        fs::copy("tests/golden/data_good.h5", &data).unwrap();
        fs::copy(RECIPE, &recipe).unwrap();
        let mut command = Command::new(TRAINER);
        command.arg("run").arg(&recipe).arg("--data").arg(&data).arg("--out").arg(&out);
        let output = command.args(["--set", "stages.identify.steps=1", "--set", "stages.denoise.steps=1"]).output().unwrap();
        assert!(output.status.success(), "{name:?}: {}", String::from_utf8_lossy(&output.stderr));
        let shown = checkpoint::load_manifest(&out).unwrap().0.provenance.dataset;
        assert_eq!(shown, data.file_name().unwrap().to_string_lossy(), "{name:?}");
    }
}

#[test]
fn probe_and_inspect_say_what_a_checkpoint_is() {
    let out = tempfile::tempdir().unwrap();
    let dir = out.path().to_str().unwrap();
    assert!(ask(&["run", RECIPE, "--out", dir, "--seed", "5", "--set", "sampler.temperature=0.1"]).status.success());
    let text = String::from_utf8(ask(&["inspect", dir]).stdout).unwrap();
    assert!(text.contains("digest") && text.contains("seed        5") && text.contains("[losses.denoise]"), "{text}");
    // What is in force was told as JSON, and of the restart nothing at all.
    for words in [
        "kappa inf, latent mean",
        "temperature 0.1\n",
        "restart     cold_distance 1.5, latent_jump 1",
        "trained for action_horizon [2], histories without [action, reward, state], kappa above 0 true, sub_steps [2]",
    ] {
        assert!(text.contains(words), "{words}: {text}");
    }
    let value: serde_json::Value = serde_json::from_slice(&ask(&["inspect", dir, "--json"]).stdout).unwrap();
    assert_eq!(value["provenance"]["seed"], 5);
    assert!(value["parameters"]["denoiser"].as_u64().unwrap() > 0);
    let probe = ["probe", dir, "tests/golden/data_good.h5", "--ahead", "1"];
    let json = ask(&[&probe[..], &["--json", "--own-rollouts", "--method", "mine"]].concat()).stdout;
    let rows: serde_json::Value = serde_json::from_slice(&json).unwrap();
    assert_eq!((&rows[0]["where"], &rows[0]["method"], &rows[0]["seed"]), (&"own_rollouts".into(), &"mine".into(), &5.into()));
    let table = String::from_utf8(ask(&probe).stdout).unwrap();
    for words in ["latent", "ceiling, no actions", "successor_state", "prior", "[0,10)", "least error of the latent at shift"] {
        assert!(table.contains(words), "{words}: {table}");
    }
}

/// One line that names the key, the file or the flag, each cause once, and a failing exit code, whatever RUST_BACKTRACE says (the server
/// told its errors in three lines and a backtrace, and candle's errors brought their own); no training directory is left behind.
#[test]
fn mistakes_get_one_clear_line() {
    let out = tempfile::tempdir().unwrap();
    let dir = out.path().join("out");
    let (to, broken) = (dir.to_str().unwrap(), out.path().join("broken"));
    fs::create_dir(&broken).unwrap();
    for name in ["config.json", "model.safetensors", "manifest.json"] {
        fs::copy(Path::new("models/tiny").join(name), broken.join(name)).unwrap();
    }
    fs::remove_file(broken.join("config.json")).unwrap();
    let run = |more: &[&'static str]| [&["run", RECIPE, "--out", to], more].concat();
    let (trainer, server) = (TRAINER, env!("CARGO_BIN_EXE_ada-server"));
    for (program, arguments, words) in [
        (trainer, run(&["--set", "losses.denoise.bacth=3"]), "unknown field `bacth`"),
        (trainer, run(&["--data", "tests/golden/data_nan.h5"]), "NaN at row 30"),
        (trainer, run(&["--data", "nowhere.h5"]), "nowhere.h5"),
        (trainer, run(&["--set", "model.plan.level_max=3"]), "sub_steps * positions <= level_max"),
        (trainer, run(&["--set", "name=\"a b\""]), "`name`"),
        (trainer, vec!["run", "nowhere.toml"], "nowhere.toml"),
        (trainer, vec!["inspect", to], "manifest.json"),
        (trainer, vec!["inspect", broken.to_str().unwrap()], "config.json"),
        (trainer, vec!["defaults", "models/tiny", to, "--set", "sampler.kapa=1"], "unknown field `kapa`"),
        (server, vec!["--models", "nowhere"], "models.dir nowhere"),
        (server, vec!["--models", "models", "--default-model", "nobody", "--listen", "127.0.0.1:0"], "there are: cheetah-gale-s,"),
        (server, vec!["--set", "engine.wrokers=2"], "wrokers"),
        (server, vec!["--config", "nowhere.toml"], "nowhere.toml"),
        (server, vec!["--listen", "192.0.2.1:1"], "server.listen 192.0.2.1:1"),
    ] {
        let output = Command::new(program).args(&arguments).env("RUST_BACKTRACE", "1").env("ADA__TELEMETRY__LOG", "off").output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        let first = text.lines().next().unwrap_or_default();
        assert!(!output.status.success() && first.starts_with("error: ") && text.contains(words), "{arguments:?}: {text}");
        assert!(!text.to_lowercase().contains("backtrace") && !text.contains("Caused by"), "{text}");
        assert!(text.matches("os error").count() <= 1 && text.matches(words).count() == 1, "{text}");
        assert!(!dir.exists(), "nothing is written before the checks");
    }
}
