//! What a file is that is not a data set as described in docs/data.md, and the way out.

use super::links::Links;
use std::{fs::File, io::Read, path::Path};

const WAY_OUT: &str = "docs/data.md shows how to write its steps into such a file";
const IMPORTED: &str = "`ada-import` makes such a file of it (docs/data.md)";

/// Beginnings of files that are not HDF5.
const BEGINNINGS: [(&[u8], &str); 4] = [
    (b"PAR1", "a Parquet file, as LeRobot has them"),
    (b"PK\x03\x04", "a ZIP archive, as NumPy's .npz files are"),
    (b"\x93NUMPY", "a NumPy array"),
    (b"\x1f\x8b", "a gzip archive"),
];

/// Files of a folder that say what it is.
const FOLDERS: [(&str, &str); 5] = [
    ("meta/info.json", "a LeRobot data set"),
    ("data/main_data.hdf5", "a Minari data set"),
    ("main_data.hdf5", "a Minari data set"),
    (".zgroup", "a Zarr store"),
    ("zarr.json", "a Zarr store"),
];

/// Why a path is not an HDF5 file, where that can be told.
pub fn not_hdf5(path: &Path) -> Option<String> {
    if path.is_dir() {
        let what = FOLDERS.iter().find(|(name, _)| path.join(name).exists()).map_or("not a file", |(_, what)| what);
        let way_out = if what.contains("Minari") { IMPORTED } else { WAY_OUT };
        return Some(format!("is a folder ({what}), expected an HDF5 file; {way_out}"));
    }
    let mut head = Vec::new();
    File::open(path).ok()?.take(8).read_to_end(&mut head).ok()?;
    let (_, what) = BEGINNINGS.iter().find(|(beginning, _)| head.starts_with(beginning))?;
    Some(format!("is {what}, expected an HDF5 file; {WAY_OUT}"))
}

/// What an HDF5 file without the arrays is: layouts that have a group for each episode.
pub fn other_layout(root: &Links, inside_data: &Links) -> Option<String> {
    let numbered = |links: &Links, prefix: &str| {
        let number = |name: &str| name.strip_prefix(prefix).is_some_and(|rest| rest.parse::<u64>().is_ok());
        links.keys().find(|name| number(name)).cloned()
    };
    let (what, group) = if let Some(name) = numbered(root, "episode_") {
        ("Minari", name)
    } else if let Some(name) = numbered(inside_data, "demo_") {
        ("robomimic or LIBERO", format!("data/{name}"))
    } else {
        return None;
    };
    Some(format!("this is a file of {what}, with a group for each episode (`{group}`); {IMPORTED}"))
}

/// The names there are, for one that is missing.
pub fn names(root: &Links) -> String {
    const SHOWN: usize = 8;
    let mut names: Vec<String> = root.keys().take(SHOWN).map(|name| format!("`{name}`")).collect();
    if root.len() > SHOWN {
        names.push(format!("{} more", root.len() - SHOWN));
    }
    if names.is_empty() { "nothing".into() } else { names.join(", ") }
}
