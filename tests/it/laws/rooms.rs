//! Rooms do not mix, and the model is built in one order.

use super::{
    crate_sources, hold_but_for,
    imports::{Import, Path},
    texts,
};
use std::collections::BTreeSet;

/// (module, modules that nothing in it may name, in tests neither).
const APART: &[(&str, &[&str])] = &[
    ("model", &["serve", "train"]),
    ("serve", &["train"]),
    ("train", &["serve"]),
    ("bin::server", &["train"]),
    ("bin::trainer", &["serve"]),
    ("serve::session", &["serve::engine", "serve::registry", "serve::service", "serve::grpc", "serve::http"]),
    ("serve::engine", &["serve::session", "serve::registry", "serve::service", "serve::grpc", "serve::http"]),
    ("serve::registry", &["serve::service", "serve::grpc", "serve::http"]),
    ("serve::service", &["serve::grpc", "serve::http", "serve::listener"]),
    ("serve::grpc", &["serve::http"]),
    ("serve::http", &["serve::grpc"]),
];

/// Imports through a wall, (file, file that it names): each to be undone.
const KNOWN_ACROSS: &[(&str, &str)] =
    &[("serve/session/flight.rs", "serve/engine/mod.rs"), ("serve/session/mod.rs", "serve/engine/mod.rs")];
/// Imports against the order of `src/lib.rs`, likewise.
const KNOWN_UPWARD: &[(&str, &str)] = &[];

/// Whether a file belongs to a module: is its file, or that of a module below it.
pub fn belongs(file: &str, module: &str) -> bool {
    let rest = file.strip_prefix(&module.replace("::", "/"));
    rest.is_some_and(|rest| rest.starts_with('/') || rest == ".rs")
}

/// Imports that cross a wall.
pub fn across(imports: &[Import]) -> BTreeSet<(String, String)> {
    let crosses = |import: &&Import| {
        let walls = APART.iter().filter(|(room, _)| belongs(&import.from, room));
        walls.flat_map(|(_, others)| *others).any(|other| belongs(&import.to, other))
    };
    imports.iter().filter(crosses).map(|import| (import.from.clone(), import.to.clone())).collect()
}

/// The order of the model's modules as `map` prints it, lowest first: `model: a, b <- {c | d} <- e`, on lines of their own.
pub fn order(map: &str) -> Vec<Vec<String>> {
    let mut lines = map.lines().skip_while(|line| !line.starts_with("//! model: "));
    let first = lines.next().and_then(|line| line.strip_prefix("//! model: ")).expect("the map says what may use what");
    let rest = lines.map_while(|line| line.strip_prefix("//!     "));
    let order: String = std::iter::once(first).chain(rest).collect();
    let names = |rank: &str| rank.split([',', '|', '{', '}', ' ']).filter(|name| !name.is_empty()).map(str::to_owned).collect();
    order.split("<-").map(names).collect()
}

/// Imports, tests' aside, of something above, or beside.
pub fn upward(imports: &[Import], order: &[Vec<String>]) -> BTreeSet<(String, String)> {
    let place = |file: &str| {
        let rank = |names: &Vec<String>| names.iter().position(|name| belongs(file, &format!("model::{name}")));
        order.iter().enumerate().find_map(|(at, names)| Some((at, rank(names)?)))
    };
    let against = |import: &&Import| match (place(&import.from), place(&import.to)) {
        (Some(from), Some(to)) => !import.test && from != to && from.0 <= to.0,
        _ => false,
    };
    imports.iter().filter(against).map(|import| (import.from.clone(), import.to.clone())).collect()
}

#[test]
fn rooms_do_not_mix() {
    hold_but_for(KNOWN_ACROSS, &across(&crate_sources().imports()), "rooms do not mix");
}

#[test]
fn the_model_is_built_in_order() {
    let (sources, order) = (crate_sources(), order(&texts()["lib.rs"]));
    hold_but_for(KNOWN_UPWARD, &upward(&sources.imports(), &order), "src/lib.rs says what may use what");
    let placed: BTreeSet<_> = order.iter().flatten().map(String::as_str).chain(["check"]).collect();
    let of_model = |(file, module): (&String, &Path)| match module.as_slice() {
        [room, name] if room == "model" && !sources.tests.contains(file) => Some(name.clone()),
        _ => None,
    };
    let unplaced: Vec<_> = sources.files.iter().filter_map(of_model).filter(|name| !placed.contains(name.as_str())).collect();
    assert_eq!(unplaced, Vec::<String>::new(), "src/lib.rs says nothing of these");
}
