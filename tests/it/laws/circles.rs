//! No two files need each other.

use super::{
    crate_sources, hold_but_for,
    imports::{Path, Sources},
};
use std::collections::{BTreeMap, BTreeSet};

/// Imports on a circle, (file, file that it names): each to be undone. A module and those right below it may name each other.
const KNOWN: &[(&str, &str)] = &[];

/// Imports, tests' aside, from and to which there is a way back, between files that are not parent and child.
pub fn circles(sources: &Sources) -> BTreeSet<(String, String)> {
    let of = |file: &str| &sources.files[file];
    let mut named: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for import in sources.imports() {
        if !import.test && !are_parent_and_child(of(&import.from), of(&import.to)) {
            named.entry(import.from).or_default().insert(import.to);
        }
    }
    let edges = named.iter().flat_map(|(from, files)| files.iter().map(move |to| (from, to)));
    edges.filter(|(from, to)| reached(&named, to).contains(from)).map(|(from, to)| (from.clone(), to.clone())).collect()
}

/// Files that `start` names, that those name, and so on.
fn reached<'a>(named: &'a BTreeMap<String, BTreeSet<String>>, start: &'a str) -> BTreeSet<&'a String> {
    let (mut seen, mut next) = (BTreeSet::new(), vec![start]);
    while let Some(file) = next.pop() {
        next.extend(named.get(file).into_iter().flatten().filter(|file| seen.insert(*file)).map(String::as_str));
    }
    seen
}

fn are_parent_and_child(a: &Path, b: &Path) -> bool {
    a.len().abs_diff(b.len()) == 1 && (a.starts_with(b) || b.starts_with(a))
}

#[test]
fn no_circles() {
    hold_but_for(KNOWN, &circles(&crate_sources()), "files must not need each other in a circle");
}
