//! Architecture rules, checked on the source code: a module imports only modules listed above it in
//! `lib.rs`, `unsafe` is confined to the image kernels, and the libraries print nothing, read no
//! clock and open no network connection.

#![allow(clippy::unwrap_used)] // a test fails by panicking

#[path = "house/source_text.rs"]
mod source_text;

use source_text::{Word, code, words};
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
/// (outermost first). Recognised are `crate::name`, members of `crate::{name, …}`, and paths with
/// enough `super::`.
fn imports_from_below(modules: &[String], path: &[&str], file: &str, text: &str) -> Vec<Breach> {
    let Some(own) = modules.iter().position(|module| path.first() == Some(&module.as_str())) else {
        return Vec::new(); // lib.rs itself
    };
    let code = code(text);
    let words: Vec<Word<'_>> = words(&code).collect();
    let is = |at: usize, text: &str| words.get(at).is_some_and(|word: &Word<'_>| word.text == text);
    let mut breaches = Vec::new();
    let mut at = 0;
    while at < words.len() {
        // Index of the token after the part of a path that leads to the crate root, if a path
        // starts here.
        let root = if is(at, "crate") && is(at + 1, "::") {
            Some(at + 2)
        } else {
            let climbed = (0..).take_while(|n| is(at + 2 * n, "super") && is(at + 2 * n + 1, "::")).count();
            (climbed >= path.len()).then_some(at + 2 * climbed)
        };
        let Some(root) = root else {
            at += 1;
            continue;
        };
        for named in first_names(&words, root) {
            if let Some(module) = modules.iter().position(|module| module == named.text)
                && module > own
            {
                breaches.push(Breach {
                    file: file.to_owned(),
                    line: named.line,
                    what: format!(
                        "`{}` imports `{}`, which lib.rs lists below it",
                        modules[own], modules[module]
                    ),
                });
            }
        }
        at = root;
    }
    breaches
}

/// The next name of a path, or of each branch of its `{…}`.
fn first_names<'a, 'b>(words: &'b [Word<'a>], at: usize) -> Vec<&'b Word<'a>> {
    if words.get(at).is_none_or(|word| word.text != "{") {
        return words.get(at).into_iter().collect();
    }
    let (mut names, mut depth) = (Vec::new(), 0);
    for (index, word) in words.iter().enumerate().skip(at) {
        match word.text {
            "{" => depth += 1,
            "}" => depth -= 1,
            _ if depth == 1 && matches!(words[index - 1].text, "{" | ",") => names.push(word),
            _ => {}
        }
        if depth == 0 {
            break;
        }
    }
    names
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
            files.extend(source_files(&path));
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

/// Runs a check over all source files of a crate and panics with all violations.
fn check_crate(name: &str, check: impl Fn(&Path, &str, &str) -> Vec<Breach>) {
    let src = crates_folder().join(name).join("src");
    let files = source_files(&src);
    assert!(!files.is_empty(), "no source files in {}", src.display());
    let mut told = String::new();
    for path in files {
        let below_src = path.strip_prefix(&src).unwrap();
        let shown = format!("crates/{name}/src/{}", below_src.display());
        for breach in check(below_src, &shown, &fs::read_to_string(&path).unwrap()) {
            told += &format!("\n{}:{}: {}", breach.file, breach.line, breach.what);
        }
    }
    assert!(told.is_empty(), "{told}\n");
}

#[test]
fn a_module_imports_only_modules_listed_above_it() {
    let lib = fs::read_to_string(crates_folder().join("odograph/src/lib.rs")).unwrap();
    let modules = listed_modules(&lib);
    assert!(modules.len() > 10 && modules[0] == "error", "{modules:?}");
    check_crate("odograph", |below_src, shown, text| {
        let path = module_path(below_src);
        let path: Vec<&str> = path.iter().map(String::as_str).collect();
        assert!(
            path.first().is_none_or(|first| modules.iter().any(|module| module == first)),
            "{shown} belongs to no module that lib.rs lists"
        );
        imports_from_below(&modules, &path, shown, text)
    });
}

#[test]
fn unsafe_code_is_confined_to_the_image_kernels() {
    let rule: [(&[&str], &str); 1] = [(&["unsafe"], "unsafe code belongs into crates/odograph/src/image")];
    let crates =
        ["odograph", "odograph-video", "odograph-map", "odograph-live", "odograph-cli", "odograph-gate"];
    for name in crates {
        check_crate(name, |below_src, shown, text| {
            let kernels = name == "odograph" && below_src.starts_with("image");
            if kernels { Vec::new() } else { forbidden_words(&rule, shown, text) }
        });
    }
}

#[test]
fn libraries_print_nothing_read_no_clock_and_open_no_connection() {
    for name in ["odograph", "odograph-video", "odograph-map"] {
        check_crate(name, |_, shown, text| forbidden_words(&NOT_IN_A_LIBRARY, shown, text));
    }
}

/// The live library needs clocks and network connections, but must not print.
#[test]
fn the_live_library_prints_nothing() {
    check_crate("odograph-live", |_, shown, text| forbidden_words(&NOT_IN_A_LIBRARY[..5], shown, text));
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
    let lines = |path: &[&str]| -> Vec<usize> {
        imports_from_below(&modules, path, "x.rs", WRONG).iter().map(|breach| breach.line).collect()
    };
    assert_eq!(lines(&["flow"]), [4, 9, 11, 12, 18]);
    // One level deeper, a single `super` stays within `flow`.
    assert_eq!(lines(&["flow", "track"]), [4, 9, 12, 18]);
    assert_eq!(lines(&["geometry"]), [4, 4, 9, 11, 12, 18]);
    assert!(lines(&["slam"]).is_empty());
    assert!(lines(&[]).is_empty());
    let first = &imports_from_below(&modules, &["flow"], "x.rs", WRONG)[0];
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
