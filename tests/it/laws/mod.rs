//! The borders that `src/lib.rs` draws, read from the source: here those of words, beside this file those of imports, fields and sizes.

mod awake;
mod circles;
mod fields;
mod imports;
mod reader;
mod rooms;

use imports::Sources;
use std::collections::{BTreeMap, BTreeSet};
use std::{fs, path::Path, path::PathBuf};

fn sources(dir: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(sources(&path));
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
    found
}

/// Every source file by its path below `src/`.
fn texts() -> BTreeMap<String, String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let read = |path: PathBuf| (path.strip_prefix(&root).unwrap().to_str().unwrap().to_owned(), fs::read_to_string(&path).unwrap());
    let files: BTreeMap<_, _> = sources(&root).into_iter().map(read).collect();
    assert!(files.len() > 20, "the sources were not found");
    files
}

/// Every source file as (path below `src/`, code without comments).
fn code() -> Vec<(String, String)> {
    let uncommented = |text: String| text.lines().map(|line| line.split("//").next().unwrap()).collect::<Vec<_>>().join("\n");
    texts().into_iter().map(|(path, text)| (path, uncommented(text))).collect()
}

/// Modules and imports of the crate.
fn crate_sources() -> Sources {
    let texts = texts();
    let sources = Sources::read(&texts);
    let unread: Vec<_> = texts.keys().filter(|file| !sources.files.contains_key(*file)).collect();
    assert!(unread.is_empty(), "no module declares {unread:?}");
    sources
}

/// Holds a law that does not hold everywhere yet: those who break it are those known to, and a list of them only ever gets shorter.
fn hold_but_for(known: &[(&str, &str)], found: &BTreeSet<(String, String)>, law: &str) {
    let known: BTreeSet<_> = known.iter().map(|(a, b)| ((*a).to_owned(), (*b).to_owned())).collect();
    let listed =
        |pairs: std::collections::btree_set::Difference<(String, String)>| pairs.map(|pair| format!("    {pair:?},\n")).collect::<String>();
    let (new, gone) = (listed(found.difference(&known)), listed(known.difference(found)));
    assert!(new.is_empty(), "{law}; these are new:\n{new}");
    assert!(gone.is_empty(), "{law}; these are no more, so take them from the list:\n{gone}");
}

/// Whether the code names this word (not as a part of a longer one).
fn names(code: &str, word: &str) -> bool {
    let is_word = |c: char| c.is_alphanumeric() || c == '_';
    code.match_indices(word).any(|(at, _)| {
        let (before, after) = (&code[..at], &code[at + word.len()..]);
        !before.ends_with(is_word) && (word.ends_with('_') || !after.starts_with(is_word))
    })
}

fn offenders(words: &[&str], allowed: &[&str]) -> Vec<String> {
    let outside = code().into_iter().filter(|(path, _)| !allowed.iter().any(|room| path.starts_with(room)));
    let offends = |(path, code): (String, String)| Some(format!("{path}: {}", words.iter().find(|word| names(&code, word))?));
    outside.filter_map(offends).collect()
}

fn hold(words: &[&str], allowed: &[&str]) {
    assert_eq!(offenders(words, allowed), Vec::<String>::new(), "{words:?} are for {allowed:?} only");
}

#[test]
fn tensors_stay_with_the_model() {
    hold(&["candle_"], &["model/", "train/"]);
}

#[test]
fn the_network_and_the_clock_stay_with_the_server() {
    let words = ["tokio", "tonic", "axum", "tower", "hyper", "SystemTime"];
    hold(&words, &["serve/", "bin/"]);
    hold(&["prost"], &["serve/", "train/tensorboard.rs"]);
    hold(&["Instant"], &["serve/", "bin/", "train/"]);
    hold(&["UdpSocket", "TcpStream", "TcpListener"], &["serve/"]);
}

/// Tokio's, which a simulation can stop and let go on: an act that waits by one clock and is late by another one is late at once, or never.
#[test]
fn the_server_has_one_clock() {
    let is_of_std = |import: &str| import.starts_with("std::") && names(import, "Instant");
    let has_another = |code: &str| code.split("use ").filter_map(|rest| rest.split_once(';')).any(|(import, _)| is_of_std(import));
    assert!(has_another("use std::{io, time::{Duration, Instant}};") && !has_another("use std::time::Duration; use tokio::time::Instant;"));
    // Of the wall clock, which goes on from one process to the next.
    let serve = code().into_iter().filter(|(path, _)| path.starts_with("serve/") && path != "serve/store/mod.rs");
    let found: Vec<_> = serve.filter(|(_, code)| has_another(code) || code.contains("std::time::Instant")).map(|(path, _)| path).collect();
    assert_eq!(found, Vec::<String>::new(), "use tokio::time::Instant");
}

#[test]
fn wire_types_stay_in_their_face() {
    hold(&["pb", "include_proto"], &["serve/grpc/"]);
    hold(
        &["serde_json"],
        &["serve/http/", "serve/replay/", "model/checkpoint", "train/", "bin/trainer.rs", "model/agent/tests/adopted.rs"],
    );
    hold(&["rmp_serde"], &["serve/session/record.rs", "serve/recording/"]);
    // A session's options are written once, with what JSON says of them: a list for each face was one more place to forget an option in.
    hold(&["ToSchema", "utoipa"], &["serve/http/", "serve/options.rs"]);
}

#[test]
fn unsafe_stays_in_the_kernels() {
    hold(&["unsafe"], &["model/nn/kernels/"]);
}

/// Half of the files fit on two screens.
#[test]
fn files_are_short() {
    let mut lengths: Vec<_> = texts().values().map(|text| text.lines().count()).collect();
    lengths.sort_unstable();
    let median = lengths[lengths.len() / 2];
    assert!(median <= 150, "the median file has {median} lines");
}

/// An error whose text holds its source must not hand it out as well: the programs tell a chain of causes, and told such a one twice
/// ("No such file or directory (os error 2): No such file or directory (os error 2)").
#[test]
fn a_cause_is_told_once() {
    let twice = |code: &str| code.lines().any(|line| line.contains("#[error(") && line.contains("{source"));
    let found: Vec<_> = code().into_iter().filter(|(_, code)| twice(code)).map(|(path, _)| path).collect();
    assert_eq!(found, Vec::<String>::new(), "name the field `reason`");
}

/// The search itself finds what it looks for.
#[test]
fn the_search_is_awake() {
    assert!(names("use candle_core::Tensor;", "candle_") && names("a tokio::spawn", "tokio"));
    assert!(!names("tokio_like", "tokio") && !names("not_tokio", "tokio") && !names("mycandle_core", "candle_"));
    assert!(!offenders(&["candle_"], &[]).is_empty() && !offenders(&["tonic"], &["bin/"]).is_empty());
}
