//! What of a recipe may change while its run is under way.
//!
//! How often something is written, and where the data set lies, changes no bit. Another number of steps does: the learning rate goes on
//! along the schedule of the new number, so the run is not the one that a fresh start would be, and the checkpoint says so.

use super::{
    position::Position,
    recipe::{Recipe, keys::leaves},
};
use serde::{Deserialize, Serialize};
use std::{
    cmp::Ordering,
    collections::{BTreeMap, BTreeSet},
    fmt,
};

/// Keys that change no bit of the result.
const FREE: [&str; 3] = ["checkpoint_every", "log_every", "data"];

/// A number of steps that was changed while its stage was under way.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Change {
    /// Dotted name of the key.
    pub key: String,
    /// Its value before.
    pub from: usize,
    /// And after.
    pub to: usize,
    /// The step of the stage at which the run went on.
    pub at: usize,
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { key, from, to, at } = self;
        write!(f, "`{key}` was {from} and is now {to}: from step {at} on, the learning rate follows the schedule of {to} steps")
    }
}

/// Compares the recipe of a state, as TOML, with that of the run that goes on, key by key. A finished run that gets more steps goes on in
/// its last stage.
///
/// # Errors
/// Names every key that may not differ, with both values.
pub fn amend(before: &str, now: &Recipe, position: &Position) -> Result<Vec<Change>, String> {
    let theirs: Recipe = toml::from_str(before).map_err(|error| format!("it cannot be read any more ({})", error.message()))?;
    let table = |recipe: &Recipe| toml::from_str(&recipe.to_toml()).expect("a recipe is TOML: is a bug");
    let (old, new) = (leaves(&table(&theirs)), leaves(&table(now)));
    let keys: BTreeSet<&String> = old.keys().chain(new.keys()).collect();
    let mut refused = Vec::new();
    let mut changes = Vec::new();
    for key in keys.into_iter().filter(|key| !FREE.contains(&key.as_str()) && old.get(*key) != new.get(*key)) {
        let shown = |leaves: &BTreeMap<String, toml::Value>| leaves.get(key).map_or("not there".into(), ToString::to_string);
        let (from, to) = (shown(&old), shown(&new));
        match steps_of(key, now).map(|(stage, to)| may_change(stage, to, now, position)) {
            Some(Ok(())) => changes.extend(change(key, &theirs, now, position)),
            Some(Err(reason)) => refused.push(format!("`{key}` was {from} and is {to}, but {reason}")),
            None => refused.push(format!("`{key}` was {from} and is {to}")),
        }
    }
    if !refused.is_empty() {
        let defaults = refused.iter().all(|text| text.starts_with("`sampler.") || text.starts_with("`restart."));
        let hint = if defaults { " (`ada-trainer defaults` changes these in the finished checkpoint)" } else { "" };
        return Err(refused.join(", ") + hint);
    }
    Ok(changes)
}

/// The stage whose number of steps this key is, and that number.
fn steps_of(key: &str, recipe: &Recipe) -> Option<(usize, usize)> {
    let name = key.strip_prefix("stages.")?.strip_suffix(".steps")?;
    let index = recipe.stages.iter().position(|stage| stage.name == name)?;
    Some((index, recipe.stages[index].steps))
}

/// Whether a stage may end after `steps` steps instead.
fn may_change(stage: usize, steps: usize, recipe: &Recipe, position: &Position) -> Result<(), String> {
    let name = &recipe.stages[stage].name;
    match stage.cmp(&position.stage) {
        Ordering::Less => Err(format!("{name} is over")),
        Ordering::Equal if steps < position.step => Err(format!("{name} has done {} steps already", position.step)),
        Ordering::Equal | Ordering::Greater => Ok(()),
    }
}

/// Nothing, if the stage has not begun: then the run is what a fresh start would be.
fn change(key: &str, before: &Recipe, now: &Recipe, position: &Position) -> Option<Change> {
    let ((stage, to), (_, from)) = (steps_of(key, now)?, steps_of(key, before)?);
    let begun = stage == position.stage && position.step > 0;
    begun.then(|| Change { key: key.into(), from, to, at: position.step })
}
