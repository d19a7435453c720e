//! The laws of imports see what they are there to see.

use super::{
    circles::circles,
    fields::open_fields,
    imports::{Import, Sources},
    reader::expanded,
    rooms::{across, order, upward},
};
use std::collections::BTreeMap;

fn files(files: &[(&str, &str)]) -> BTreeMap<String, String> {
    files.iter().map(|(file, text)| ((*file).to_owned(), (*text).to_owned())).collect()
}

/// `from -> to`, or `from (test) -> to`.
fn arrows(imports: &[Import]) -> Vec<String> {
    let test = |import: &Import| if import.test { " (test)" } else { "" };
    imports.iter().map(|import| format!("{}{} -> {}", import.from, test(import), import.to)).collect()
}

const CRATE: &[(&str, &str)] = &[
    ("lib.rs", "pub mod model; pub mod serve; pub mod train;"),
    (
        "model/mod.rs",
        "pub mod nn; mod networks; pub use networks::Networks; pub mod plain { pub use super::nn::deep::inner::Leaf as Renamed; }",
    ),
    ("model/networks.rs", "pub struct Networks;"),
    ("model/nn/mod.rs", "pub mod deep; pub use deep::*; macro_rules! each { () => { $crate::train::start() } } pub(crate) use each;"),
    ("model/nn/deep.rs", "pub mod inner; pub struct Deep; pub struct Other;"),
    ("model/nn/deep/inner.rs", "pub struct Leaf;"),
    ("serve/mod.rs", "pub mod engine;"),
    ("train/mod.rs", "pub fn start() {}"),
];

/// What `serve/engine.rs` with this text imports.
fn imported(text: &str) -> Vec<String> {
    let mut files = files(CRATE);
    files.insert("serve/engine.rs".into(), text.into());
    let imports = Sources::read(&files).imports();
    let own = imports.into_iter().filter(|import| import.from == "serve/engine.rs");
    arrows(&own.collect::<Vec<_>>())
        .into_iter()
        .map(|arrow| arrow.replace("serve/engine.rs -> ", "").replace("serve/engine.rs ", ""))
        .collect()
}

#[test]
fn nested_trees_are_expanded() {
    let tree = "use crate::{model::{self, nn::{deep::{Deep, inner::*}, Other as Another}}, train};";
    let item: syn::ItemUse = syn::parse_str(tree).unwrap();
    let told: Vec<_> =
        expanded(&item.tree).into_iter().map(|(path, name)| format!("{} {}", path.join("::"), name.unwrap_or("*".into()))).collect();
    let expected = [
        "crate::model model",
        "crate::model::nn::deep::Deep Deep",
        "crate::model::nn::deep::inner *",
        "crate::model::nn::Other Another",
        "crate::train train",
    ];
    assert_eq!(told, expected);
}

/// Whatever a path is written as.
#[test]
fn paths_lead_to_the_file_that_defines() {
    let inner = ["model/nn/deep/inner.rs"];
    for text in [
        "use crate::model::{\n    nn::{\n        deep::{\n            inner::{Leaf},\n        },\n    },\n};",
        "use super::super::model::nn::deep::inner::Leaf;",
        "use crate::model::nn::inner;",
        "use crate::model::plain::Renamed;",
        "fn f() { use super::super::{model::nn::deep::inner::Leaf}; }",
        "fn f() -> Option<crate::model::nn::inner::Leaf> { None }",
        "fn f() { println!(\"{}\", g(&[crate::model::nn::inner::Leaf])); }",
        "#[serde(with = \"crate::model::nn::inner::Leaf\")] struct S;",
        "#[error(\"{}\", crate::model::nn::inner::Leaf.0)] struct S;",
        "mod below { use super::super::super::model::nn::inner::Leaf; }",
        "macro_rules! m { () => { use crate::model::nn::{deep::{inner::Leaf}}; } }",
    ] {
        assert_eq!(imported(text), inner, "{text}");
    }
    assert_eq!(imported("use crate::model::Networks;"), ["model/networks.rs"]);
    assert_eq!(imported("use crate::model::nn::Other;"), ["model/nn/deep.rs"]);
    assert_eq!(imported("use crate::model::nn::each;"), ["model/nn/mod.rs"]);
    assert_eq!(imported("use crate::{serve::engine, train::start};"), ["train/mod.rs"]);
    assert_eq!(imported("use super::*;"), ["serve/mod.rs"]);
    assert_eq!(imported("#[cfg(test)] mod tests { use crate::train; }"), ["(test) -> train/mod.rs"]);
    assert_eq!(imported("pub(in crate::serve) struct S; // crate::train\n/// [`crate::train`]\nfn f() { \"crate::train\"; }"), [""; 0]);
    assert_eq!(imported("use ::train::start; use train::x; fn f() { std::fs::read(model::x) }"), [""; 0]);
}

#[test]
fn walls_are_seen() {
    let mut files = files(CRATE);
    files.insert("serve/engine.rs".into(), "use crate::{model::nn::Deep, train};".into());
    files.insert("bin/server.rs".into(), "use ada_diffuser::{serve::engine, train::start};".into());
    let imports = Sources::read(&files).imports();
    let found: Vec<_> = across(&imports).into_iter().map(|(from, to)| format!("{from} -> {to}")).collect();
    assert_eq!(found, ["bin/server.rs -> train/mod.rs", "model/nn/mod.rs -> train/mod.rs", "serve/engine.rs -> train/mod.rs"]);
}

#[test]
fn the_order_is_read_and_held() {
    let order = order("//! a line\n//! model: low, floor <- {left | right} <- top\n//! and more");
    assert_eq!(order, [vec!["low", "floor"], vec!["left", "right"], vec!["top"]]);
    let import = |from: &str, to: &str, test| Import { from: format!("model/{from}.rs"), to: format!("model/{to}.rs"), test };
    let fine = [
        import("top", "left/mod", false),
        import("left/a", "left/b", false),
        import("top", "elsewhere", false),
        import("low", "top", true),
    ];
    assert!(upward(&fine, &order).is_empty());
    let wrong = [import("low", "top", false), import("left/a", "right", false), import("low", "floor", false)];
    assert_eq!(upward(&wrong, &order).len(), 3);
}

#[test]
fn circles_are_seen() {
    let of = |a: &str, b: &str, c: &str| {
        let files = files(&[
            ("lib.rs", "mod a; mod b; mod c;"),
            ("a.rs", a),
            ("b.rs", b),
            ("c.rs", c),
            ("a/child.rs", "pub struct Child; use super::A;"),
        ]);
        let circles = circles(&Sources::read(&files));
        circles.into_iter().map(|(from, to)| format!("{from} -> {to}")).collect::<Vec<_>>()
    };
    assert_eq!(of("use crate::b; pub struct A;", "use crate::c;", ""), [""; 0]);
    assert_eq!(
        of("use crate::{b::{self}};", "use super::c;", "use crate::{a}; use crate::b;"),
        ["a.rs -> b.rs", "b.rs -> c.rs", "c.rs -> a.rs", "c.rs -> b.rs"]
    );
    // Parent and child, and tests.
    assert_eq!(of("mod child; pub use child::Child; pub struct A; use crate::b;", "#[cfg(test)] use crate::a::A;", ""), [""; 0]);
    // By way of a re-export: `b` needs the child, not its parent.
    assert_eq!(of("pub mod child; pub struct A; use crate::b;", "use crate::a::child::Child;", ""), [""; 0]);
    assert_eq!(
        of("pub use crate::b::B;", "pub struct B; use crate::c::C;", "pub struct C; use crate::a::B;"),
        ["b.rs -> c.rs", "c.rs -> b.rs"]
    );
}

#[test]
fn open_fields_are_seen() {
    let files = files(&[
        ("lib.rs", "mod model;"),
        ("model/mod.rs", "mod agent;"),
        (
            "model/agent/mod.rs",
            "mod types; mod walk; struct Agent { config: u32, spec: u32 } impl Agent { fn a(&self) -> u32 { self.spec } }",
        ),
        ("model/agent/types.rs", "pub struct Told { pub action: u32 }"),
        (
            "model/agent/walk.rs",
            "use super::Agent; struct Walk { own: u32, pub(super) x: u32 } impl Agent { fn b(&self) { f(&self.config, self.own) } }",
        ),
    ]);
    let found: Vec<_> = open_fields(&Sources::read(&files), &files).into_iter().map(|(file, field)| format!("{file} {field}")).collect();
    assert_eq!(found, ["model/agent/walk.rs Agent.config", "model/agent/walk.rs Walk.x"]);
}
