//! The borders that `src/lib.rs` draws, read from the source.

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

/// Every source file as (path below `src/`, code without comments).
fn code() -> Vec<(String, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let read = |path: PathBuf| {
        let text = fs::read_to_string(&path).unwrap();
        let code: Vec<_> = text.lines().map(|line| line.split("//").next().unwrap()).collect();
        (path.strip_prefix(&root).unwrap().to_str().unwrap().to_owned(), code.join("\n"))
    };
    let files: Vec<_> = sources(&root).into_iter().map(read).collect();
    assert!(files.len() > 20, "the sources were not found");
    files
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
    let words = ["tokio", "tonic", "axum", "tower", "prost", "hyper", "SystemTime"];
    hold(&words, &["serve/", "bin/"]);
    hold(&["Instant"], &["serve/", "bin/", "train/"]);
    hold(&["UdpSocket", "TcpStream", "TcpListener"], &["serve/"]);
}

#[test]
fn wire_types_stay_in_their_face() {
    hold(&["pb", "include_proto"], &["serve/grpc/"]);
    hold(&["serde_json"], &["serve/http/", "model/checkpoint", "train/", "bin/trainer.rs"]);
    hold(&["ToSchema", "utoipa"], &["serve/http/"]);
}

#[test]
fn rooms_do_not_mix() {
    let uses = |room: &str, words: &[&str]| {
        let inside = code().into_iter().filter(|(path, _)| path.starts_with(room));
        let found: Vec<_> = inside.filter(|(_, code)| words.iter().any(|word| code.contains(word))).map(|(path, _)| path).collect();
        assert_eq!(found, Vec::<String>::new(), "{room} must not use {words:?}");
    };
    uses("model/", &["crate::serve", "crate::train"]);
    uses("serve/", &["crate::train"]);
    uses("train/", &["crate::serve"]);
    uses("serve/session/", &["serve::engine", "serve::registry", "serve::service", "serve::grpc", "serve::http"]);
    uses("serve/engine/", &["serve::session", "serve::registry", "serve::service", "serve::grpc", "serve::http"]);
    uses("serve/registry.rs", &["serve::service", "serve::grpc", "serve::http"]);
    uses("serve/service.rs", &["serve::grpc", "serve::http", "serve::listener"]);
    uses("serve/grpc/", &["serve::http"]);
    uses("serve/http/", &["serve::grpc"]);
}

#[test]
fn unsafe_stays_in_the_kernels() {
    hold(&["unsafe"], &["model/nn/kernels/"]);
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
