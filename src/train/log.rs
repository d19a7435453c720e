//! What a run says: JSON lines and TensorBoard on disk, a progress bar on a terminal, plain lines elsewhere.
//!
//! Steps of TensorBoard count on from stage to stage and attempt to attempt ([`Position::total`]): its readers understand a step that falls as
//! a restart, and drop every curve from there on.

use super::{position::Position, tensorboard::EventWriter};
use anyhow::{Context, Result};
use indicatif::{FormattedDuration, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};
use serde_json::{Map, Value, json};
use std::{
    fmt,
    fs::{self, File, OpenOptions},
    io::{self, Write},
    path::Path,
    time::Duration,
};

/// Off a terminal, a line at least this often, seconds.
const QUIET_MAX: f64 = 30.0;

/// The wall clock, seconds since 1970; given by the binary, since training itself depends on no clock.
pub type Clock = dyn Fn() -> f64 + Send;

/// The log of one run.
pub struct Log {
    /// Names of the stages, in order.
    stages: Vec<String>,
    lines: File,
    /// The last line before this process.
    last: String,
    events: EventWriter,
    bar: ProgressBar,
    clock: Box<Clock>,
    pace: Pace,
    /// Of each scalar since the last line: sum and count, for a loss need not be evaluated at every step.
    sums: Vec<(&'static str, f64, usize)>,
    /// When this process opened it.
    opened: f64,
}

/// How fast a stage goes.
#[derive(Default)]
struct Pace {
    /// Name of the stage.
    stage: String,
    /// Steps of the stage.
    steps: usize,
    /// Where this process began with it: step and time.
    from: (usize, f64),
    /// Time of the last line.
    said: f64,
}

impl Pace {
    /// `denoise step 300 of 3000, 41.2 steps/s, 00:01:05 left`
    fn text(&self, position: &Position, now: f64) -> String {
        let (step, steps, elapsed) = (position.step, self.steps, now - self.from.1);
        let mut text = format!("{} step {step} of {steps}", self.stage);
        let rate = step.saturating_sub(self.from.0) as f64 / elapsed;
        if let Some(left) = Duration::try_from_secs_f64(steps.saturating_sub(step) as f64 / rate).ok().filter(|_| rate.is_finite()) {
            text += &format!(", {}, {} left", rate_text(rate), FormattedDuration(left));
        }
        text
    }
}

/// Steps per second, or where they are slower the seconds that one takes.
fn rate_text(rate: f64) -> String {
    match rate {
        100.0.. => format!("{rate:.0} steps/s"),
        1.0.. => format!("{rate:.1} steps/s"),
        _ if rate > 0.0 => format!("{:.1} s/step", 1.0 / rate),
        _ => "-".into(),
    }
}

/// A line for the reader. Where nobody is there to read it any more (a terminal that hung up), training goes on.
fn tell(text: &str) {
    let _nobody_reads = writeln!(io::stderr(), "{text}");
}

impl Log {
    /// Opens `log.jsonl` and a new event file in `dir`, at `position` in a run of these stages: lines of later steps, written before a kill, are dropped.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn open(dir: &Path, stages: Vec<String>, position: &Position, clock: Box<Clock>) -> Result<Self> {
        fs::create_dir_all(dir).with_context(|| format!("cannot make {}", dir.display()))?;
        let path = dir.join("log.jsonl");
        let text = match fs::read(&path) {
            Ok(bytes) => String::from_utf8_lossy(&bytes).into_owned(),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(error) => return Err(error).with_context(|| format!("cannot read {}", path.display())),
        };
        let kept: String = text.lines().filter(|line| is_before(line, &stages, position)).flat_map(|line| [line, "\n"]).collect();
        fs::write(&path, &kept).with_context(|| format!("cannot write {}", path.display()))?;
        let last = kept.lines().next_back().unwrap_or_default().to_owned();
        let lines = OpenOptions::new().append(true).open(&path)?;
        let opened = clock();
        let events = EventWriter::create(dir, position.total() as u64, opened)?;
        let bar = ProgressBar::with_draw_target(Some(0), ProgressDrawTarget::stderr());
        let template = "{prefix} {wide_bar} {pos}/{len}  {msg}  {rate}, {eta_precise} left";
        let style = ProgressStyle::with_template(template).expect("the template is constant: is a bug");
        // What cannot be written on a terminal has no reader.
        bar.set_style(style.with_key("rate", |state: &ProgressState, out: &mut dyn fmt::Write| {
            let _nobody_reads = out.write_str(&rate_text(state.per_sec()));
        }));
        Ok(Self { stages, lines, last, events, bar, clock, pace: Pace::default(), sums: Vec::new(), opened })
    }

    /// A stage begins at `position` and has `steps` steps.
    pub fn begin(&mut self, position: &Position, steps: usize) {
        let now = (self.clock)();
        let stage = self.stages[position.stage].clone();
        self.sums.clear();
        self.bar.set_prefix(stage.clone());
        self.pace = Pace { stage, steps, from: (position.step, now), said: now };
        self.bar.set_length(steps as u64);
        self.bar.set_position(position.step as u64);
        self.bar.reset_eta();
        if self.bar.is_hidden() {
            tell(&self.pace.text(position, now));
        }
    }

    /// Adds the scalars of one step; every `every` steps their means are written.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn step(&mut self, position: &Position, every: usize, scalars: &[(&'static str, f64)]) -> Result<()> {
        self.bar.set_position(position.step as u64);
        let now = (self.clock)();
        if self.bar.is_hidden() && now - self.pace.said >= QUIET_MAX && !position.step.is_multiple_of(every) {
            self.pace.said = now;
            tell(&self.pace.text(position, now));
        }
        for (name, value) in scalars {
            match self.sums.iter_mut().find(|(known, ..)| known == name) {
                Some((_, sum, count)) => (*sum, *count) = (*sum + value, *count + 1),
                None => self.sums.push((name, *value, 1)),
            }
        }
        if !position.step.is_multiple_of(every) {
            return Ok(());
        }
        let sums = std::mem::take(&mut self.sums);
        let means: Vec<(&'static str, f64)> = sums.into_iter().map(|(name, sum, count)| (name, sum / count as f64)).collect();
        self.write(position, &means)
    }

    /// Writes scalars as they are.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn write(&mut self, position: &Position, scalars: &[(&'static str, f64)]) -> Result<()> {
        let stage = &self.stages[position.stage];
        let mut line = Map::from_iter([
            ("stage".to_string(), json!(stage)),
            ("attempt".to_string(), json!(position.attempt)),
            ("step".to_string(), json!(position.step)),
        ]);
        line.extend(scalars.iter().map(|(name, value)| (name.to_string(), json!(value))));
        let line = Value::Object(line).to_string();
        if line == self.last {
            // A measurement after the last step before a kill; it is on disk already.
            return Ok(());
        }
        writeln!(self.lines, "{line}")?;
        let prefix = if position.attempt == 0 { stage.clone() } else { format!("{stage}.attempt{}", position.attempt) };
        let tags: Vec<(String, f64)> = scalars.iter().map(|(name, value)| (format!("{prefix}/{name}"), *value)).collect();
        let now = (self.clock)();
        self.events.scalars(position.total() as u64, now, tags.iter().map(|(tag, value)| (tag.as_str(), *value)))?;
        let text: Vec<String> = scalars.iter().map(|(name, value)| format!("{name} {value:.4}")).collect();
        if self.bar.is_hidden() {
            self.pace.said = now;
            tell(&format!("{}: {}", self.pace.text(position, now), text.join("  ")));
        } else {
            self.bar.set_message(text.first().cloned().unwrap_or_default());
        }
        Ok(())
    }

    /// Since this process opened it.
    pub fn seconds(&self) -> f64 {
        (self.clock)() - self.opened
    }

    /// A sentence for the reader.
    pub fn say(&self, text: &str) {
        self.bar.suspend(|| tell(text));
    }
}

/// Whether a line of the log was written at or before `position`; a torn last line was not.
fn is_before(line: &str, stages: &[String], position: &Position) -> bool {
    let Ok(line) = serde_json::from_str::<Value>(line) else { return false };
    let number = |key: &str| line[key].as_u64().map(|value| value as usize);
    let stage = line["stage"].as_str().and_then(|name| stages.iter().position(|stage| stage == name));
    match (number("attempt"), stage, number("step")) {
        (Some(attempt), Some(stage), Some(step)) => (attempt, stage, step) <= (position.attempt, position.stage, position.step),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A run of hours into a file was silent, or told a step without total, rate or end; the bar said `1.2345e-3/s`.
    #[test]
    fn progress_has_total_rate_and_time_left() {
        let pace = Pace { stage: "denoise".into(), steps: 3000, from: (100, 50.0), said: 50.0 };
        let text = |step, now| pace.text(&Position { step, ..Position::START }, now);
        assert_eq!(text(300, 54.0), "denoise step 300 of 3000, 50.0 steps/s, 00:00:54 left");
        assert_eq!(text(100, 50.0), "denoise step 100 of 3000", "nothing is known yet");
        assert_eq!(text(101, 850.0), "denoise step 101 of 3000, 800.0 s/step, 26d 20:13:20 left");
        assert_eq!([0.0012345, 0.5, 12.34, 432.1].map(rate_text), ["810.0 s/step", "2.0 s/step", "12.3 steps/s", "432 steps/s"]);
    }

    #[test]
    fn a_resumed_log_drops_what_comes_after_the_state() {
        let dir = tempfile::tempdir().unwrap();
        let at = |stage, step| Position { stage, step, ..Position::START };
        let stages = || vec!["identify".to_string(), "denoise".to_string()];
        let mut log = Log::open(dir.path(), stages(), &at(0, 0), Box::new(|| 0.0)).unwrap();
        for step in 1..=4 {
            log.step(&at(0, step), 2, &[("loss", step as f64)]).unwrap();
        }
        log.write(&at(1, 2), &[("loss", 9.0)]).unwrap();
        writeln!(log.lines, "{{\"stage\": \"sta").unwrap();
        Log::open(dir.path(), stages(), &at(0, 3), Box::new(|| 1.0)).unwrap();
        let text = fs::read_to_string(dir.path().join("log.jsonl")).unwrap();
        let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert_eq!(lines, [json!({"stage": "identify", "attempt": 0, "step": 2, "loss": 1.5})]);
    }
}
