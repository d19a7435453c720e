//! The three ways to set a thing, for every key there is: the keys are those of the defaults, so a new one is tested by itself.

use super::*;
use std::{ffi::OsString, os::unix::ffi::OsStringExt};
use toml::Value;

/// Another legal value for keys whose text is one of a few words.
const OTHER_WORDS: [(&str, &str); 3] = [("models.weights", "bf16"), ("telemetry.format", "json"), ("store.durability", "power")];
/// For any other text: an address, a path, a name.
const OTHER_TEXT: &str = "127.0.0.1:1";

#[derive(Clone, Copy, Debug)]
enum Way {
    File,
    Environment,
    Flag,
}

const WAYS: [Way; 3] = [Way::File, Way::Environment, Way::Flag];

/// The settings, not validated, with these said, each (way, `section.key`, the text after the `=` sign of a file, whether it is quoted there).
fn load(said: &[(Way, &str, &str, bool)]) -> Result<Config, ConfigError> {
    let (mut file, mut environment, mut flags) = (String::new(), Vec::new(), Vec::new());
    for (way, key, text, quoted) in said {
        match way {
            Way::File => {
                let (section, name) = key.split_once('.').unwrap();
                let text = if *quoted { Value::from(*text).to_string() } else { (*text).to_owned() };
                file += &format!("[{section}]\n{name} = {text}\n");
            }
            Way::Environment => {
                environment.push((format!("ADA__{}", key.to_uppercase().replace('.', "__")).into(), (*text).into()));
            }
            Way::Flag => flags.push(((*key).to_owned(), (*text).to_owned())),
        }
    }
    let path = tempfile::NamedTempFile::with_suffix(".toml").unwrap();
    std::fs::write(path.path(), file).unwrap();
    Config::read(Some(path.path()), environment.into_iter(), &flags)
}

/// Every key with its default.
fn keys() -> Vec<(String, Value)> {
    let Value::Table(sections) = Value::try_from(Config::default()).unwrap() else { panic!() };
    let keys = sections.into_iter().flat_map(|(section, keys)| {
        let Value::Table(keys) = keys else { panic!("{section} is no section") };
        keys.into_iter().map(move |(key, value)| (format!("{section}.{key}"), value))
    });
    keys.collect()
}

/// Another legal value of a key: as text, and whether a file puts it in quotes.
fn other(key: &str, default: &Value) -> (String, bool) {
    match default {
        Value::Integer(value) => ((value + 1).to_string(), false),
        Value::Float(value) => (format!("{:?}", value + 0.5), false),
        Value::Boolean(value) => ((!value).to_string(), false),
        Value::String(_) => (OTHER_WORDS.iter().find(|(word, _)| *word == key).map_or(OTHER_TEXT, |(_, text)| text).to_owned(), true),
        // Lists are written alike in all three.
        Value::Array(_) => ("[\"http://a.example\"]".to_owned(), false),
        other => (other.to_string(), false),
    }
}

/// Once a file took `1_000` where flags and environment did not, and all of them took 1.5 for a whole number and `yes` for true.
#[test]
fn every_key_means_the_same_whoever_says_it() {
    for (key, default) in keys() {
        let (text, quoted) = other(&key, &default);
        let [file, environment, flag] = WAYS.map(|way| load(&[(way, &key, &text, quoted)]).unwrap_or_else(|error| panic!("{error}")));
        assert_ne!(file, Config::default(), "{key} = {text} changes nothing");
        assert_eq!((&file, &file), (&environment, &flag), "{key} = {text}");
        let same = |said: &str, as_file: &str| {
            let file = load(&[(Way::File, &key, as_file, quoted)]);
            for way in [Way::Environment, Way::Flag] {
                match (&file, load(&[(way, &key, said, quoted)])) {
                    (Ok(file), Ok(other)) => assert_eq!(*file, other, "{key} = {said:?}, {way:?}"),
                    (Err(file), Err(other)) => assert!(
                        file.to_string().starts_with(&key) && other.to_string().starts_with(&key),
                        "{key} = {said:?} is not named: {file}; {other}"
                    ),
                    (file, other) => panic!("{key} = {said:?}: {file:?} in a file, {other:?} as {way:?}"),
                }
            }
        };
        for text in ["1_000", "0x10", "+7", "007", "1e2", "1.5", "-1", "true", "yes", "on", "1", "inf", "[1, 2]", "{}", "nothing"] {
            // What is no value of TOML is a syntax error in a file; there the nearest thing to it is the text.
            let as_file = if quoted || text.parse::<Value>().is_ok() { text.to_owned() } else { Value::from(text).to_string() };
            same(text, &as_file);
        }
        for text in ["", " "] {
            same(text, if quoted { text } else { "\"\"" });
        }
    }
}

#[test]
fn the_file_gives_way_to_the_environment_and_that_to_flags() {
    for (key, default) in keys() {
        let (other, quoted) = other(&key, &default);
        let default = default.as_str().map_or_else(|| default.to_string(), str::to_owned);
        let [alone, as_before] = [&other, &default].map(|text| load(&[(Way::Flag, &key, text, quoted)]).unwrap());
        for (weak, strong) in [(Way::File, Way::Environment), (Way::File, Way::Flag), (Way::Environment, Way::Flag)] {
            for (first, second, expected) in [(&default, &other, &alone), (&other, &default, &as_before)] {
                let said = [(weak, key.as_str(), first.as_str(), quoted), (strong, &key, second, quoted)];
                assert_eq!(load(&said).unwrap(), *expected, "{said:?}");
            }
        }
    }
}

#[test]
fn unknown_keys_are_refused_by_name() {
    for way in WAYS {
        for (key, known) in [("engine.worker", "[engine] holds"), ("engin.workers", "the sections are"), ("engine.workers.more", "holds")] {
            let message = load(&[(way, key, "1", false)]).unwrap_err().to_string();
            // A dotted key of a file is a table in the key before it.
            let named = message.starts_with(key) || message.starts_with("engine.workers: invalid type: map");
            assert!(named && (message.contains(known) || message.contains("map")), "{way:?} {key}: {message}");
        }
    }
    assert!(load(&[(Way::Flag, "engine", "1", false)]).unwrap_err().to_string().starts_with("engine: "));
    let file = |text: &str| {
        let path = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(path.path(), text).unwrap();
        Config::read(Some(path.path()), std::iter::empty(), &[]).map_err(|error| error.to_string())
    };
    assert!(file("[nothing]").unwrap_err().starts_with("nothing: no such setting; the sections are"));
    assert!(file("engine = 3").unwrap_err().starts_with("engine: no such setting; [engine] holds"));
    assert_eq!(file("[engine]\n[models]\n").unwrap(), Config::default());
    assert!(file("[engine\n").unwrap_err().contains("line 1"));
}

#[test]
fn what_is_wrong_is_named_with_its_place() {
    let message = |way, key, text| load(&[(way, key, text, false)]).and_then(Config::validated).unwrap_err().to_string();
    let wrong = "engine.workers: invalid type: string \"many\", expected usize";
    assert_eq!(message(Way::Flag, "engine.workers", "many"), format!("{wrong} (on the command line)"));
    assert_eq!(message(Way::Environment, "engine.workers", "many"), format!("{wrong} (in the environment, ADA__ENGINE__WORKERS)"));
    assert!(message(Way::File, "engine.workers", "\"many\"").starts_with(&format!("{wrong} (in /")));
    assert_eq!(message(Way::File, "engine.queue_len_max", "0"), "engine.queue_len_max: must be at least 1");
    assert_eq!(message(Way::File, "sessions.ttl_ms", "90000000"), "sessions.ttl_ms: must be at most sessions.ttl_ms_max");
    let latin = OsString::from_vec(vec![b'm', 0xe9]);
    let latin = Config::read(None, std::iter::once(("ADA__MODELS__DIR".into(), latin)), &[]).unwrap_err();
    assert!(latin.to_string().starts_with("models.dir: is not UTF-8"), "{latin}");
    let foreign = (OsString::from_vec(vec![0xff]), OsString::from_vec(vec![0xff]));
    assert!(Config::read(None, std::iter::once(foreign), &[]).is_ok(), "what others keep in the environment");
    assert!(Config::read(Some(Path::new("/nowhere.toml")), std::iter::empty(), &[]).unwrap_err().to_string().contains("/nowhere.toml"));
}

#[test]
fn the_address_is_checked_at_the_start() {
    let listen = |address| load(&[(Way::Flag, "server.listen", address, true)]).and_then(Config::validated);
    for good in ["127.0.0.1:0", "[::1]:7777", "localhost:7777", "my-host.example:80"] {
        assert_eq!(listen(good).unwrap().server.listen, good);
    }
    for bad in ["7777", ":7777", "localhost", "localhost:", "localhost:http", "localhost:65536", "::1:7777", "a b:1"] {
        let message = listen(bad).unwrap_err().to_string();
        assert!(message.starts_with("server.listen: must be HOST:PORT"), "{bad}: {message}");
    }
}

/// `deploy/server.toml` holds every key with its default, and nothing else.
#[test]
fn deploy_file_lists_every_default() {
    let listed: Value = toml::from_str(include_str!("../../../deploy/server.toml")).unwrap();
    assert_eq!(listed, Value::try_from(Config::default()).unwrap());
}
