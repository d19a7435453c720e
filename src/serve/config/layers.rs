//! The three ways to set a thing. All go through one reader, so that a value means the same whoever says it: what a file would hold after
//! the `=` sign; for keys that hold text the quotes are left out where there is no file.

use super::{Config, ConfigError};
use serde::Deserialize;
use std::{ffi::OsString, fmt, fs, path::Path, path::PathBuf};
use toml::{Table, Value};

const PREFIX: &str = "ADA__";
const SEPARATOR: &str = "__";

/// Where a setting was said.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origin {
    /// In this file.
    File(PathBuf),
    /// In this variable.
    Environment(String),
    /// On the command line.
    Flag,
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Origin::File(path) => write!(f, "in {}", path.display()),
            Origin::Environment(name) => write!(f, "in the environment, {name}"),
            Origin::Flag => f.write_str("on the command line"),
        }
    }
}

/// All settings so far: one layer over the other.
pub(super) struct Layers {
    table: Table,
    config: Config,
}

impl Layers {
    pub fn new() -> Self {
        let config = Config::default();
        Self { table: Table::try_from(&config).expect("the defaults are plain data, or it is a bug"), config }
    }

    /// What they make together.
    pub fn into_config(self) -> Config {
        self.config
    }

    /// Every key of the file.
    pub fn file(&mut self, path: &Path) -> Result<(), ConfigError> {
        let text = fs::read_to_string(path).map_err(|error| ConfigError::File { path: path.to_owned(), reason: error.to_string() })?;
        let table: Table =
            text.parse().map_err(|error: toml::de::Error| ConfigError::Toml { path: path.to_owned(), reason: error.to_string() })?;
        let origin = Origin::File(path.to_owned());
        for (section, value) in table {
            match value {
                Value::Table(keys) if !keys.is_empty() || self.table.contains_key(&section) => {
                    keys.into_iter().try_for_each(|(key, value)| self.put(&format!("{section}.{key}"), value, &origin))?;
                }
                value => self.put(&section, value, &origin)?,
            }
        }
        Ok(())
    }

    /// Every variable `ADA__SECTION__KEY`, in whatever case.
    pub fn environment(&mut self, variables: impl Iterator<Item = (OsString, OsString)>) -> Result<(), ConfigError> {
        for (name, text) in variables {
            let name = name.to_string_lossy();
            if !name.get(..PREFIX.len()).is_some_and(|start| start.eq_ignore_ascii_case(PREFIX)) {
                continue;
            }
            let key = name[PREFIX.len()..].to_ascii_lowercase().replace(SEPARATOR, ".");
            let origin = Origin::Environment(name.into_owned());
            match text.to_str() {
                Some(text) => self.put_text(&key, text, &origin)?,
                None => return Err(ConfigError::Value { key, reason: "is not UTF-8".to_owned(), origin }),
            }
        }
        Ok(())
    }

    /// Every `--set section.key=value`; of several for a key the last one counts.
    pub fn flags(&mut self, flags: &[(String, String)]) -> Result<(), ConfigError> {
        flags.iter().try_for_each(|(key, text)| self.put_text(key, text, &Origin::Flag))
    }

    fn put_text(&mut self, key: &str, text: &str, origin: &Origin) -> Result<(), ConfigError> {
        let as_text = || Value::String(text.to_owned());
        let value = match self.slot(key, origin)? {
            Value::String(_) => as_text(),
            // What is no value of TOML is of the wrong type, and the check below says which type it should be.
            _ => text.trim().parse().unwrap_or_else(|_| as_text()),
        };
        self.put(key, value, origin)
    }

    fn put(&mut self, key: &str, value: Value, origin: &Origin) -> Result<(), ConfigError> {
        *self.slot(key, origin)? = value;
        // Without this value it was right.
        let wrong =
            |error: toml::de::Error| ConfigError::Value { key: key.to_owned(), reason: error.message().to_owned(), origin: origin.clone() };
        self.config = Config::deserialize(self.table.clone()).map_err(wrong)?;
        Ok(())
    }

    fn slot(&mut self, key: &str, origin: &Origin) -> Result<&mut Value, ConfigError> {
        let (section, name) = key.split_once('.').unwrap_or((key, ""));
        let names = |table: &Table| table.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
        let unknown = |known| ConfigError::Unknown { key: key.to_owned(), known, origin: origin.clone() };
        let sections = names(&self.table);
        let Some(Value::Table(keys)) = self.table.get_mut(section) else {
            return Err(unknown(format!("the sections are {sections}")));
        };
        let known = names(keys);
        keys.get_mut(name).ok_or_else(|| unknown(format!("[{section}] holds {known}")))
    }
}
