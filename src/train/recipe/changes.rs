//! What is changed of a recipe before it is run: a method that is data is a few keys beside those of an environment, so that N methods in M
//! environments are N + M files.

use super::{
    error::RecipeError,
    keys::{put, remove, set},
};
use serde::Deserialize;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// Changes in the order in which they are made: methods, single values, the data set.
#[derive(Clone, Debug, Default)]
pub struct Changes {
    /// Files of methods: `remove`, a list of keys, and `[set]`, keys and their values; docs/methods.md.
    pub with: Vec<PathBuf>,
    /// `stages.denoise.steps=100`; nothing behind the sign takes the key out.
    pub overrides: Vec<String>,
    /// Path of another data set.
    pub data: Option<PathBuf>,
}

/// A method as changes of an environment's recipe. The recipe's name gets that of the file behind it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct MethodFile {
    /// Keys that go, by dotted names; those that are not there may be named.
    #[serde(default)]
    remove: Vec<String>,
    /// Keys and their values, by dotted names, after that. A value that is a table takes the place of the whole one.
    #[serde(default)]
    set: Table,
}

impl Changes {
    /// Single values alone.
    pub fn values(overrides: &[impl ToString]) -> Self {
        Self { overrides: overrides.iter().map(ToString::to_string).collect(), ..Self::default() }
    }

    /// Makes them.
    ///
    /// # Errors
    /// If a file cannot be read or is no method, or a key leads nowhere.
    pub(super) fn make(&self, recipe: &mut Table) -> Result<(), RecipeError> {
        for path in &self.with {
            MethodFile::read(path)?.make(path, recipe)?;
        }
        self.overrides.iter().try_for_each(|text| set(recipe, text))?;
        if self.data.is_some() {
            // The path itself is set later: not every path can be a TOML string. The key need not be in the file.
            recipe.insert("data".into(), Value::String(String::new()));
        }
        Ok(())
    }
}

impl MethodFile {
    fn read(path: &Path) -> Result<Self, RecipeError> {
        let text = std::fs::read_to_string(path).map_err(|error| RecipeError::Io { path: path.into(), reason: error.to_string() })?;
        toml::from_str(&text).map_err(|error| RecipeError::Syntax { path: path.into(), reason: error.to_string() })
    }

    fn make(self, path: &Path, recipe: &mut Table) -> Result<(), RecipeError> {
        let at = |key: &str, hint: String| RecipeError::Method { path: path.into(), key: key.into(), hint };
        self.remove.iter().try_for_each(|key| remove(recipe, key).map_err(|hint| at(key, hint)))?;
        for (key, value) in self.set {
            put(recipe, &key, value).map_err(|hint| at(&key, hint))?;
        }
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        if let Some(Value::String(name)) = recipe.get_mut("name") {
            *name = format!("{name}-{stem}");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recipe() -> Table {
        toml::from_str("name = \"wind\"\nplan = { kind = \"a\", x = 1 }\n[[stages]]\nname = \"one\"\nloss = { a = 1, b = 2 }").unwrap()
    }

    #[test]
    fn a_method_takes_out_and_puts_in() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("other.toml");
        let text = "remove = [\"stages.one.loss.b\", \"not.there\"]\n[set]\n\"plan\" = { kind = \"b\" }\n\"stages.one.steps\" = 3";
        std::fs::write(&path, text).unwrap();
        let mut changed = recipe();
        let changes = Changes { with: vec![path.clone()], overrides: vec!["plan.y=2".into(), "stages.one.loss=".into()], data: None };
        changes.make(&mut changed).unwrap();
        let expected = "name = \"wind-other\"\nplan = { kind = \"b\", y = 2 }\n[[stages]]\nname = \"one\"\nsteps = 3";
        assert_eq!(changed, toml::from_str::<Table>(expected).unwrap());
        for (text, words) in [
            ("[set]\n\"name.x\" = 1", "`name.x`"),
            ("remove = [\"stages.two.x\"]", "`stages` has no `two`, but: one"),
            ("put = 1", "unknown field `put`"),
        ] {
            std::fs::write(&path, text).unwrap();
            let error = changes.make(&mut recipe()).unwrap_err().to_string();
            assert!(error.contains(words), "{text}: {error}");
        }
    }

    /// A stage goes by its name.
    #[test]
    fn a_stage_is_taken_out() {
        let mut changed = recipe();
        Changes::values(&["stages.one="]).make(&mut changed).unwrap();
        assert_eq!(changed["stages"], Value::Array(Vec::new()));
    }
}
