//! What a run says: JSON lines and TensorBoard on disk, a progress bar on a terminal, plain lines elsewhere.

use super::{
    resume::{Position, Stage},
    tensorboard::EventWriter,
};
use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::{Map, Value, json};
use std::{
    fs::{self, File, OpenOptions},
    io::Write,
    path::Path,
};

/// The wall clock, seconds since 1970; given by the binary, since training itself depends on no clock.
pub type Clock = dyn Fn() -> f64 + Send;

/// The log of one run.
pub struct Log {
    lines: File,
    events: EventWriter,
    bar: ProgressBar,
    clock: Box<Clock>,
    sums: Vec<(&'static str, f64)>,
    count: usize,
}

impl Log {
    /// Opens `log.jsonl` and a new event file in `dir`, at `position`: lines of later steps, written before a kill, are dropped.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn open(dir: &Path, position: &Position, clock: Box<Clock>) -> Result<Self> {
        fs::create_dir_all(dir).with_context(|| format!("cannot make {}", dir.display()))?;
        let path = dir.join("log.jsonl");
        let text = match fs::read(&path) {
            Ok(bytes) => String::from_utf8_lossy(&bytes).into_owned(),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(error) => return Err(error).with_context(|| format!("cannot read {}", path.display())),
        };
        let kept: String = text.lines().filter(|line| is_before(line, position)).flat_map(|line| [line, "\n"]).collect();
        fs::write(&path, kept).with_context(|| format!("cannot write {}", path.display()))?;
        let lines = OpenOptions::new().append(true).open(&path)?;
        let events = EventWriter::create(dir, position.step as u64, clock())?;
        let bar = ProgressBar::with_draw_target(Some(0), ProgressDrawTarget::stderr());
        let template = "{prefix} {wide_bar} {pos}/{len}  {msg}  {per_sec}, {eta} left";
        bar.set_style(ProgressStyle::with_template(template).expect("the template is constant: is a bug"));
        Ok(Self { lines, events, bar, clock, sums: Vec::new(), count: 0 })
    }

    /// A stage begins at `position` and has `steps` steps.
    pub fn begin(&self, position: &Position, steps: usize) {
        self.bar.set_length(steps as u64);
        self.bar.set_position(position.step as u64);
        self.bar.reset_eta();
        self.bar.set_prefix(position.stage.name());
        if self.bar.is_hidden() {
            eprintln!("{}: step {} of {steps}", position.stage.name(), position.step);
        }
    }

    /// Adds the scalars of one step; every `every` steps their means are written.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn step(&mut self, position: &Position, every: usize, scalars: &[(&'static str, f64)]) -> Result<()> {
        self.bar.set_position(position.step as u64);
        if self.sums.len() != scalars.len() {
            self.sums = scalars.iter().map(|(name, _)| (*name, 0.0)).collect();
            self.count = 0;
        }
        self.sums.iter_mut().zip(scalars).for_each(|(sum, (_, value))| sum.1 += value);
        self.count += 1;
        if !position.step.is_multiple_of(every) {
            return Ok(());
        }
        let count = std::mem::take(&mut self.count) as f64;
        let means: Vec<(&'static str, f64)> = std::mem::take(&mut self.sums).into_iter().map(|(name, sum)| (name, sum / count)).collect();
        self.write(position, &means)
    }

    /// Writes scalars as they are.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn write(&mut self, position: &Position, scalars: &[(&'static str, f64)]) -> Result<()> {
        let stage = position.stage.name();
        let mut line = Map::from_iter([
            ("stage".to_string(), json!(stage)),
            ("attempt".to_string(), json!(position.attempt)),
            ("step".to_string(), json!(position.step)),
        ]);
        line.extend(scalars.iter().map(|(name, value)| (name.to_string(), json!(value))));
        writeln!(self.lines, "{}", Value::Object(line))?;
        let prefix = if position.attempt == 0 { stage.to_string() } else { format!("{stage}.attempt{}", position.attempt) };
        let tags: Vec<(String, f64)> = scalars.iter().map(|(name, value)| (format!("{prefix}/{name}"), *value)).collect();
        self.events.scalars(position.step as u64, (self.clock)(), tags.iter().map(|(tag, value)| (tag.as_str(), *value)))?;
        let text: Vec<String> = scalars.iter().map(|(name, value)| format!("{name} {value:.4}")).collect();
        if self.bar.is_hidden() {
            eprintln!("{stage} {:>6}  {}", position.step, text.join("  "));
        } else {
            self.bar.set_message(text.first().cloned().unwrap_or_default());
        }
        Ok(())
    }

    /// A sentence for the reader.
    pub fn say(&self, text: &str) {
        self.bar.suspend(|| eprintln!("{text}"));
    }
}

/// Whether a line of the log was written at or before `position`; a torn last line was not.
fn is_before(line: &str, position: &Position) -> bool {
    let Ok(line) = serde_json::from_str::<Value>(line) else { return false };
    let number = |key: &str| line[key].as_u64().map(|value| value as usize);
    let stage = line["stage"].as_str().and_then(Stage::named);
    match (stage, number("attempt"), number("step")) {
        (Some(stage), Some(attempt), Some(step)) => (stage, attempt, step) <= (position.stage, position.attempt, position.step),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_resumed_log_drops_what_comes_after_the_state() {
        let dir = tempfile::tempdir().unwrap();
        let at = |stage, step| Position { stage, attempt: 0, step };
        let mut log = Log::open(dir.path(), &at(Stage::Latent, 0), Box::new(|| 0.0)).unwrap();
        for step in 1..=4 {
            log.step(&at(Stage::Latent, step), 2, &[("loss", step as f64)]).unwrap();
        }
        log.write(&at(Stage::Refine, 2), &[("loss", 9.0)]).unwrap();
        writeln!(log.lines, "{{\"stage\": \"sta").unwrap();
        Log::open(dir.path(), &at(Stage::Latent, 3), Box::new(|| 1.0)).unwrap();
        let text = fs::read_to_string(dir.path().join("log.jsonl")).unwrap();
        let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert_eq!(lines, [json!({"stage": "stage1", "attempt": 0, "step": 2, "loss": 1.5})]);
    }
}
