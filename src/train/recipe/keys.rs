//! Dotted names of a recipe's values: how `--set` names one, and how two recipes are compared. A table in a list goes by its own `name`,
//! so the steps of a stage are `stages.denoise.steps`, wherever in the list it stands.

use super::error::RecipeError;
use std::collections::BTreeMap;
use toml::{Table, Value};

/// All values by their dotted names. Of a list of named tables the order is a value too, under the name of the list.
pub fn leaves(table: &Table) -> BTreeMap<String, Value> {
    let mut leaves = BTreeMap::new();
    gather("", table, &mut leaves);
    leaves
}

fn gather(prefix: &str, table: &Table, leaves: &mut BTreeMap<String, Value>) {
    for (key, value) in table {
        let key = format!("{prefix}{key}");
        match (value, named(value)) {
            (Value::Table(inner), _) => gather(&format!("{key}."), inner, leaves),
            (_, Some(tables)) => {
                for (name, inner) in &tables {
                    gather(&format!("{key}.{name}."), inner, leaves);
                }
                leaves.insert(key, tables.into_iter().map(|(name, _)| name).collect::<Vec<_>>().into());
            }
            (value, None) => drop(leaves.insert(key, value.clone())),
        }
    }
}

/// The tables of a list in which every one has a name.
fn named(value: &Value) -> Option<Vec<(&str, &Table)>> {
    let tables = value.as_array().filter(|all| !all.is_empty())?.iter();
    tables.map(|value| value.as_table().and_then(|table| Some((table.get("name")?.as_str()?, table)))).collect()
}

/// Sets `a.b.c=value` in a table; the value is read as TOML, else taken as a string. Nothing behind the sign takes the key out.
///
/// # Errors
/// If there is no `=`, no such table in a list, or the way leads through a value that is no table.
pub fn set(table: &mut Table, text: &str) -> Result<(), RecipeError> {
    let malformed = |hint: String| RecipeError::Override { text: text.into(), hint };
    let (key, value) = text.split_once('=').ok_or_else(|| malformed(String::new()))?;
    let parsed = toml::from_str::<Table>(&format!("value = {value}")).ok().and_then(|mut table| table.remove("value"));
    let value = parsed.unwrap_or_else(|| Value::String(value.into()));
    match &value {
        Value::String(nothing) if nothing.is_empty() && !text.contains('"') => remove(table, key.trim()).map_err(malformed),
        _ => put(table, key.trim(), value).map_err(malformed),
    }
}

/// Puts a value at `a.b.c`, in the place of one that is there.
///
/// # Errors
/// What there is instead of such a place.
pub fn put(table: &mut Table, key: &str, value: Value) -> Result<(), String> {
    let (way, last) = key.rsplit_once('.').unwrap_or(("", key));
    if last.is_empty() {
        return Err(String::new());
    }
    table_at(table, way, true)?.map(|inner| inner.insert(last.into(), value));
    Ok(())
}

/// Takes `a.b.c` out, if it is there; of a list of named tables the one with that name.
///
/// # Errors
/// As of [`put`].
pub fn remove(table: &mut Table, key: &str) -> Result<(), String> {
    let (way, last) = key.rsplit_once('.').unwrap_or(("", key));
    if let Some(tables) = table.get_mut(way).and_then(Value::as_array_mut) {
        tables.retain(|table| table.get("name").and_then(Value::as_str) != Some(last));
        return Ok(());
    }
    table_at(table, way, false)?.map(|inner| inner.remove(last));
    Ok(())
}

/// The table at the end of a way, made where there is none if `make` says so. In a list of named tables the way goes on by a name.
fn table_at<'a>(table: &'a mut Table, way: &str, make: bool) -> Result<Option<&'a mut Table>, String> {
    let mut names = way.split('.').filter(|name| !name.is_empty());
    let mut inner = table;
    while let Some(name) = names.next() {
        if !inner.contains_key(name) && !make {
            return Ok(None);
        }
        let entry = inner.entry(name).or_insert_with(|| Value::Table(Table::new()));
        let of_list = if entry.is_array() { names.next() } else { None };
        inner = match of_list {
            None => entry.as_table_mut().ok_or_else(|| format!("; `{name}` has no keys"))?,
            Some(wanted) => {
                let known = named(entry).unwrap_or_default().iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ");
                let tables = entry.as_array_mut().into_iter().flatten().filter_map(Value::as_table_mut);
                let mut called = tables.filter(|table| table.get("name").and_then(Value::as_str) == Some(wanted));
                called.next().ok_or_else(|| format!("; `{name}` has no `{wanted}`, but: {known}"))?
            }
        };
    }
    Ok(Some(inner))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        toml::from_str("a = 1\nb = { c = [1, 2] }\n[[stages]]\nname = \"one\"\nsteps = 2\n[[stages]]\nname = \"two\"\nsteps = 3").unwrap()
    }

    #[test]
    fn values_go_by_dotted_names() {
        let names: Vec<String> = leaves(&table()).into_keys().collect();
        let expected = ["a", "b.c", "stages", "stages.one.name", "stages.one.steps", "stages.two.name", "stages.two.steps"];
        assert_eq!(names, expected);
        let mut turned = table();
        turned["stages"].as_array_mut().unwrap().reverse();
        let (one, other) = (leaves(&table()), leaves(&turned));
        let differ: Vec<&String> = one.keys().filter(|key| one[*key] != other[*key]).collect();
        assert_eq!(differ, ["stages"], "the order counts");
    }

    #[test]
    fn what_is_set_is_named_the_same_way() {
        let mut table = table();
        for text in ["stages.two.steps=7", "stages.one.gate.tries=2", "b.d=inf", "e=word"] {
            set(&mut table, text).unwrap();
        }
        let leaves = leaves(&table);
        assert_eq!((&leaves["stages.two.steps"], &leaves["stages.one.steps"]), (&Value::Integer(7), &Value::Integer(2)));
        assert_eq!((&leaves["stages.one.gate.tries"], &leaves["e"]), (&Value::Integer(2), &Value::String("word".into())));
        for (text, words) in [
            ("stages.three.steps=1", "`stages` has no `three`, but: one, two"),
            ("a.b=1", "`a` has no keys"),
            ("a", "expected KEY=VALUE"),
            (".=1", "expected KEY=VALUE"),
        ] {
            let error = set(&mut table, text).unwrap_err().to_string();
            assert!(error.contains(words), "{text}: {error}");
        }
    }
}
