//! Architecture rules, checked on the source code: a module imports only modules listed above it in
//! `lib.rs`, the modules of a room import each other in no circle, a room's own file is its
//! `mod.rs`, `unsafe` is confined to the image kernels, and the libraries print nothing, read no
//! clock and open no network connection. Packages depend on each other in no circle.

#![allow(clippy::unwrap_used)] // a test fails by panicking

#[path = "house/imports.rs"]
mod imports;
#[path = "house/source_text.rs"]
mod source_text;

use imports::{Imports, Module, absolute, circle, paths};
use source_text::{Word, code, words};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// A violation of a rule.
#[derive(Debug, PartialEq, Eq)]
struct Breach {
    file: String,
    line: usize,
    what: String,
}

fn crates_folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The modules declared in a `lib.rs`, in order.
fn listed_modules(lib: &str) -> Vec<String> {
    let code = code(lib);
    let words: Vec<Word<'_>> = words(&code).collect();
    let listed = words.windows(3).filter(|three| three[0].text == "mod" && three[2].text == ";");
    listed.map(|three| three[1].text.to_owned()).collect()
}

/// Finds imports of modules that are listed below the importing one. `file` is the module `path`
/// (outermost first).
fn imports_from_below(modules: &[String], path: &[String], file: &str, text: &str) -> Vec<Breach> {
    let Some(own) = modules.iter().position(|module| path.first() == Some(module)) else {
        return Vec::new(); // lib.rs itself
    };
    let code = code(text);
    let words: Vec<Word<'_>> = words(&code).collect();
    let mut breaches = Vec::new();
    for found in paths(&words) {
        let Some(imported) = absolute(path, &found.names, |_| false) else { continue };
        if let Some(module) = modules.iter().position(|module| imported.first() == Some(module))
            && module > own
        {
            let (importing, imported) = (&modules[own], &modules[module]);
            let what = format!("`{importing}` imports `{imported}`, which lib.rs lists below it");
            breaches.push(Breach { file: file.to_owned(), line: found.line, what });
        }
    }
    breaches.dedup();
    breaches
}

/// Tokens that must not occur in a library.
const NOT_IN_A_LIBRARY: [(&[&str], &str); 11] = [
    (&["println", "!"], "a library prints nothing"),
    (&["eprintln", "!"], "a library prints nothing"),
    (&["print", "!"], "a library prints nothing"),
    (&["eprint", "!"], "a library prints nothing"),
    (&["dbg", "!"], "a library prints nothing"),
    (&["Instant"], "a library reads no clock"),
    (&["SystemTime"], "a library reads no clock"),
    (&["std", "::", "net"], "a library opens no connection"),
    (&["TcpStream"], "a library opens no connection"),
    (&["TcpListener"], "a library opens no connection"),
    (&["UdpSocket"], "a library opens no connection"),
];

fn forbidden_words(rules: &[(&[&str], &str)], file: &str, text: &str) -> Vec<Breach> {
    let code = code(text);
    let words: Vec<Word<'_>> = words(&code).collect();
    let mut breaches = Vec::new();
    for (pattern, why) in rules {
        for found in words.windows(pattern.len()) {
            if found.iter().zip(*pattern).all(|(word, wanted)| word.text == *wanted) {
                let what = format!("`{}`: {why}", pattern.concat());
                breaches.push(Breach { file: file.to_owned(), line: found[0].line, what });
            }
        }
    }
    breaches
}

/// All source files below `folder` in a fixed order, except files that contain only tests.
fn source_files(folder: &Path) -> Vec<PathBuf> {
    let mut entries: Vec<PathBuf> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    entries.sort();
    let mut files = Vec::new();
    for path in entries {
        if path.is_dir() {
            if path.file_name().unwrap() != "tests" {
                files.extend(source_files(&path));
            }
        } else if path.extension().is_some_and(|e| e == "rs") && path.file_name().unwrap() != "tests.rs" {
            files.push(path);
        }
    }
    files
}

/// The module path of a file below `src`, outermost first: `flow/track.rs` is `[flow, track]`,
/// `flow/mod.rs` is `[flow]`.
fn module_path(below_src: &Path) -> Vec<String> {
    let without_ending = below_src.with_extension("");
    let names = without_ending.iter().map(|name| name.to_string_lossy().into_owned());
    names.filter(|name| name != "mod" && name != "lib").collect()
}

/// Holds that the modules of a crate are listed in the order of their dependencies.
fn check_order(name: &str) {
    let lib = fs::read_to_string(crates_folder().join(name).join("src/lib.rs")).unwrap();
    let modules = listed_modules(&lib);
    assert!(modules.len() > 10, "{modules:?}");
    check_crate(name, |below_src, shown, text| {
        let path = module_path(below_src);
        let only_in_tests = |module: &str| lib.contains(&format!("#[cfg(test)]\nmod {module};"));
        assert!(
            path.first().is_none_or(|first| modules.contains(first) || only_in_tests(first)),
            "{shown} belongs to no module that lib.rs lists"
        );
        imports_from_below(&modules, &path, shown, text)
    });
}

/// Runs a check over all source files of a crate and panics with all violations.
fn check_crate(name: &str, check: impl Fn(&Path, &str, &str) -> Vec<Breach>) {
    let src = crates_folder().join(name).join("src");
    let files = source_files(&src);
    assert!(!files.is_empty(), "no source files in {}", src.display());
    let mut message = String::new();
    for path in files {
        let below_src = path.strip_prefix(&src).unwrap();
        let shown = format!("crates/{name}/src/{}", below_src.display());
        for breach in check(below_src, &shown, &fs::read_to_string(&path).unwrap()) {
            message += &format!("\n{}:{}: {}", breach.file, breach.line, breach.what);
        }
    }
    assert!(message.is_empty(), "{message}\n");
}

#[test]
fn a_module_imports_only_modules_listed_above_it() {
    check_order("odograph");
    check_order("odograph-session");
}

/// The crates of the workspace, and that of ROS 2.
const CRATES: [&str; 13] = [
    "odograph",
    "odograph-calibration",
    "odograph-simulation",
    "odograph-video",
    "odograph-map",
    "odograph-live",
    "odograph-site",
    "odograph-session",
    "odograph-report",
    "odograph-cli",
    "odograph-gate",
    "odograph-reliability",
    "odograph-ros2",
];

/// The source text of every module of a crate.
fn sources(name: &str) -> BTreeMap<Module, String> {
    let src = crates_folder().join(name).join("src");
    let source =
        |path: PathBuf| (module_path(path.strip_prefix(&src).unwrap()), fs::read_to_string(&path).unwrap());
    source_files(&src).into_iter().map(source).collect()
}

#[test]
fn the_modules_of_a_room_import_each_other_in_no_circle() {
    let mut message = String::new();
    for name in CRATES {
        for (room, modules) in Imports::of(&sources(name)).circles() {
            let room = room.join("::");
            message += &format!("\n{name}, {room}: {} → {}", modules.join(" → "), modules[0]);
        }
    }
    assert!(message.is_empty(), "{message}\n");
}

/// Crates whose rooms have their own code in `room/mod.rs`, not in `room.rs` beside `room/`.
const WITH_MOD_FILES: [&str; 11] = [
    "odograph",
    "odograph-calibration",
    "odograph-simulation",
    "odograph-video",
    "odograph-map",
    "odograph-live",
    "odograph-site",
    "odograph-session",
    "odograph-report",
    "odograph-gate",
    "odograph-reliability",
];

#[test]
fn the_own_file_of_a_room_is_its_mod_file() {
    for name in WITH_MOD_FILES {
        for path in source_files(&crates_folder().join(name).join("src")) {
            let room = path.with_extension("");
            assert!(!room.is_dir(), "{} belongs to {}", path.display(), room.join("mod.rs").display());
        }
    }
}

#[test]
fn unsafe_code_is_confined_to_the_image_kernels() {
    let rule: [(&[&str], &str); 1] = [(&["unsafe"], "unsafe code belongs into crates/odograph/src/image")];
    for name in CRATES {
        check_crate(name, |below_src, shown, text| {
            let kernels = name == "odograph" && below_src.starts_with("image");
            if kernels { Vec::new() } else { forbidden_words(&rule, shown, text) }
        });
    }
}

#[test]
fn libraries_print_nothing_read_no_clock_and_open_no_connection() {
    for name in [
        "odograph",
        "odograph-calibration",
        "odograph-simulation",
        "odograph-video",
        "odograph-map",
        "odograph-report",
    ] {
        check_crate(name, |_, shown, text| forbidden_words(&NOT_IN_A_LIBRARY, shown, text));
    }
}

/// These need clocks, and three of them network connections; none prints.
#[test]
fn the_session_live_ros_and_site_libraries_print_nothing() {
    for name in ["odograph-session", "odograph-live", "odograph-ros2", "odograph-site"] {
        check_crate(name, |_, shown, text| forbidden_words(&NOT_IN_A_LIBRARY[..5], shown, text));
    }
}

/// The crates that are packaged, each with those of ours that its package depends on: one for tests
/// alone that has no version is left out of it.
fn packages() -> BTreeMap<String, BTreeSet<String>> {
    let mut packages = BTreeMap::new();
    for folder in fs::read_dir(crates_folder()).unwrap() {
        let manifest = fs::read_to_string(folder.unwrap().path().join("Cargo.toml")).unwrap();
        let manifest: toml::Table = toml::from_str(&manifest).unwrap();
        if manifest["package"].get("publish") == Some(&toml::Value::Boolean(false)) {
            continue;
        }
        let name = manifest["package"]["name"].as_str().unwrap();
        let mut needed = BTreeSet::new();
        for section in ["dependencies", "dev-dependencies"] {
            let listed = manifest.get(section).and_then(toml::Value::as_table).into_iter().flatten();
            for (other, how) in listed.filter(|(other, _)| other.starts_with("odograph")) {
                if how.get("workspace").or(how.get("version")).is_some() {
                    needed.insert(other.clone());
                } else {
                    assert_eq!(section, "dev-dependencies", "{name} gives no version of {other}");
                }
            }
        }
        packages.insert(name.to_owned(), needed);
    }
    packages
}

#[test]
fn packages_depend_on_each_other_in_no_circle() {
    let packages = packages();
    assert!(packages.len() > 8, "{packages:?}");
    for package in packages.keys() {
        assert_eq!(circle(&packages, package), None);
    }
}

/// A small library with violations, and with text that only resembles them.
const WRONG: &str = r##"
//! Not an import: crate::slam.
use crate::error::Error; // nor this: crate::slam
use crate::{geometry::{Ray, slam}, flow, slam::Map as M};
/* nor /* this: */ crate::slam */
const TEXT: &str = "crate::slam \" crate::slam";
const RAW: &str = r#"crate::slam " crate::slam"#;
const QUOTE: char = '"';
fn f<'a>(x: &'a crate::slam::Map) { unsafe { println!("{x:?}") } }
mod inner;
use super::slam;
use super::super::slam as far;
#[cfg(test)]
mod tests {
    use crate::slam::Map;
    fn f() { println!("}"); }
}
use crate::slam::Map;
#[cfg(test)]
use crate::slam::OnlyInTests;
fn g() -> std::time::Instant { std::net::lookup() }
"##;

#[test]
fn the_import_check_finds_exactly_the_violations() {
    let modules =
        listed_modules("//! mod no;\npub mod error;\nmod geometry;\npub mod flow;\npub mod slam;\n");
    assert_eq!(modules, ["error", "geometry", "flow", "slam"]);
    let below = |path: &[&str]| {
        let path: Module = path.iter().map(|&name| name.to_owned()).collect();
        imports_from_below(&modules, &path, "x.rs", WRONG)
    };
    let lines = |path: &[&str]| -> Vec<usize> { below(path).iter().map(|breach| breach.line).collect() };
    assert_eq!(lines(&["flow"]), [4, 9, 11, 12, 18]);
    // One level deeper, a single `super` stays within `flow`.
    assert_eq!(lines(&["flow", "track"]), [4, 9, 12, 18]);
    assert_eq!(lines(&["geometry"]), [4, 4, 9, 11, 12, 18]);
    assert!(lines(&["slam"]).is_empty());
    assert!(lines(&[]).is_empty());
    let first = &below(&["flow"])[0];
    assert_eq!(first.what, "`flow` imports `slam`, which lib.rs lists below it");
}

#[test]
fn the_token_check_finds_exactly_the_violations() {
    let found: Vec<(usize, String)> = forbidden_words(&NOT_IN_A_LIBRARY, "x.rs", WRONG)
        .into_iter()
        .map(|breach| (breach.line, breach.what))
        .collect();
    assert_eq!(found.len(), 3, "{found:?}");
    assert!(found[0].0 == 9 && found[0].1.starts_with("`println!`"));
    assert!(found[1].0 == 21 && found[1].1.starts_with("`Instant`"));
    assert!(found[2].0 == 21 && found[2].1.starts_with("`std::net`"));
    assert_eq!(forbidden_words(&[(&["unsafe"], "")], "x.rs", WRONG)[0].line, 9);
}

#[test]
fn module_paths_follow_from_file_paths() {
    assert_eq!(module_path(Path::new("flow/track.rs")), ["flow", "track"]);
    assert_eq!(module_path(Path::new("flow/mod.rs")), ["flow"]);
    assert_eq!(module_path(Path::new("camera.rs")), ["camera"]);
    assert!(module_path(Path::new("lib.rs")).is_empty());
}

#[test]
fn circles_are_found_through_re_exports_and_nowhere_else() {
    let texts = [
        ("", "mod a; mod b; mod room; use a::A;"),
        ("a", "pub struct A; use crate::b::B; // use crate::room::X;"),
        ("b", "pub struct B; const TEXT: &str = \"crate::a::A\";"),
        ("room", "mod one; mod two; mod three; pub use two::{self, Two as Other};"),
        ("room::one", "use super::{Own, two::Two};"),
        ("room::two", "use super::three::{self, Three}; pub struct Two;"),
        ("room::three", "use crate::b; use super::one::{One as Two, X};"),
    ];
    let module =
        |path: &str| -> Module { path.split("::").filter(|n| !n.is_empty()).map(Into::into).collect() };
    let sources = |texts: &[(&str, &str)]| {
        Imports::of(&texts.iter().map(|(path, text)| (module(path), (*text).to_owned())).collect())
    };
    let names = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>();
    assert_eq!(sources(&texts).circles(), [(names(&["room"]), names(&["one", "two", "three"]))]);
    let mut straight = texts;
    straight[6].1 = "use crate::b; fn f() { Vec::<u8>::new() }";
    assert!(sources(&straight).circles().is_empty());
    // Through the name that the room re-exports.
    straight[6].1 = "use super::Two;";
    straight[3].1 = "mod one; mod two; mod three; pub use two::Two;";
    assert_eq!(sources(&straight).circles(), [(names(&["room"]), names(&["three", "two"]))]);
}
