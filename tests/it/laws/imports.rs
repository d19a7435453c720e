//! Who imports whom: every path that the source names, followed through re-exports to the file that defines what it means.

use super::reader::Reader;
use std::collections::{BTreeMap, BTreeSet};

/// Segments of a path, or of a module's place below the crate.
pub type Path = Vec<String>;

/// Re-exports that are followed, one after the other.
const DEPTH_MAX: usize = 32;

/// Names of one module.
#[derive(Default)]
pub struct Scope {
    pub file: String,
    /// Items defined here.
    pub defined: BTreeSet<String>,
    /// Names brought by a `use`, as it is written.
    pub used: BTreeMap<String, Path>,
    /// Paths before a star.
    pub stars: Vec<Path>,
}

/// A path where it is written.
pub struct Named {
    pub file: String,
    pub module: Path,
    pub path: Path,
    pub test: bool,
}

/// A file that names what another one defines.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Import {
    pub from: String,
    pub to: String,
    /// Whether only tests do it.
    pub test: bool,
}

/// What a path leads to: a module, or the module that defines an item.
enum Found {
    Module(Path),
    Item(Path),
}

/// Source files below one root, and what they name.
#[derive(Default)]
pub struct Sources {
    pub scopes: BTreeMap<Path, Scope>,
    pub named: Vec<Named>,
    /// Module of each file.
    pub files: BTreeMap<String, Path>,
    /// Files that only tests are compiled from.
    pub tests: BTreeSet<String>,
}

impl Sources {
    /// Reads `lib.rs` and the programs in `bin/`, and whatever modules they declare; `files` by their paths.
    pub fn read(files: &BTreeMap<String, String>) -> Self {
        let mut sources = Self::default();
        for file in files.keys() {
            match file.strip_prefix("bin/").and_then(|name| name.strip_suffix(".rs")) {
                Some(program) => Reader::read(&mut sources, files, file, vec!["bin".into(), program.into()], false),
                None if file == "lib.rs" => Reader::read(&mut sources, files, file, Path::new(), false),
                None => {}
            }
        }
        sources
    }

    /// Imports between files, in order, each once; one that is not a test's alone is not said to be one.
    pub fn imports(&self) -> Vec<Import> {
        let mut found: BTreeMap<(String, String), bool> = BTreeMap::new();
        for named in &self.named {
            let Some(module) = self.defining(&named.module, &named.path) else { continue };
            let to = self.scopes[&module].file.clone();
            if to != named.file {
                *found.entry((named.file.clone(), to)).or_insert(true) &= named.test;
            }
        }
        found.into_iter().map(|((from, to), test)| Import { from, to, test }).collect()
    }

    /// The module that defines what `path`, written in `module`, means; none if that is not of this crate.
    pub fn defining(&self, module: &[String], path: &[String]) -> Option<Path> {
        match self.find(module, path, 0)? {
            Found::Module(module) | Found::Item(module) => Some(module),
        }
    }

    fn find(&self, module: &[String], path: &[String], depth: usize) -> Option<Found> {
        let (first, mut rest) = path.split_first()?;
        let root = if module.first().is_some_and(|first| first == "bin") { 2 } else { 0 };
        let mut at = match first.as_str() {
            "crate" => module[..root].to_vec(),
            "ada_diffuser" => Path::new(),
            "self" => module.to_vec(),
            "super" => module[..module.len().checked_sub(1)?].to_vec(),
            name => match self.look_up(module, name, depth)? {
                Found::Module(module) => module,
                item @ Found::Item(_) => return Some(item),
            },
        };
        while let Some((name, after)) = rest.split_first() {
            rest = after;
            if name == "super" {
                at.pop();
                continue;
            }
            match self.look_up(&at, name, depth) {
                Some(Found::Module(module)) => at = module,
                Some(item) => return Some(item),
                // What a macro defined, or something that another crate defines and this module hands on.
                None => return Some(Found::Item(at)),
            }
        }
        Some(Found::Module(at))
    }

    /// What `name` means in `module`: a module below it, an item of its own, or what a `use` brought.
    fn look_up(&self, module: &[String], name: &str, depth: usize) -> Option<Found> {
        let (scope, below) = (self.scopes.get(module)?, [module, &[name.to_owned()]].concat());
        if self.scopes.contains_key(&below) {
            return Some(Found::Module(below));
        }
        if scope.defined.contains(name) {
            return Some(Found::Item(module.to_vec()));
        }
        if depth > DEPTH_MAX {
            return None;
        }
        match scope.used.get(name) {
            Some(path) => self.find(module, path, depth + 1),
            None => scope.stars.iter().find_map(|path| match self.find(module, path, depth + 1)? {
                Found::Module(starred) => self.look_up(&starred, name, depth + 1),
                Found::Item(_) => None,
            }),
        }
    }
}
