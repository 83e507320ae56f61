//! What the modules of a crate import from each other.

use super::source_text::{Word, code, words};
use std::collections::{BTreeMap, BTreeSet};

/// A module of a crate, outermost name first; the root is empty.
pub type Module = Vec<String>;

/// A path in the code, such as `super::flow::track`, and the line of its last name.
#[derive(Debug, PartialEq, Eq)]
pub struct CodePath<'a> {
    pub names: Vec<&'a str>,
    pub line: usize,
}

/// All paths of at least two names. `use a::{b, c::d}` has the paths `a::b` and `a::c::d`.
pub fn paths<'a>(words: &[Word<'a>]) -> Vec<CodePath<'a>> {
    let is = |at: usize, text: &str| words.get(at).is_some_and(|word| word.text == text);
    let (mut found, mut at) = (Vec::new(), 0);
    while at < words.len() {
        let begins = is_name(words[at].text) && is(at + 1, "::") && !(at > 0 && is(at - 1, "::"));
        at = if begins { branch(words, at, &[], &mut found) } else { at + 1 };
    }
    found
}

/// Reads one branch of a tree of paths; returns the index of the token after it.
fn branch<'a>(words: &[Word<'a>], mut at: usize, stem: &[&'a str], found: &mut Vec<CodePath<'a>>) -> usize {
    let mut names = stem.to_vec();
    let mut line = words[at].line;
    while let Some(word) = words.get(at) {
        if word.text == "{" {
            at += 1;
            while words.get(at).is_some_and(|word| word.text != "}") {
                let next = branch(words, at, &names, found);
                // Past `as Alias` and the comma.
                let end = words[next..].iter().position(|word| matches!(word.text, "," | "}"));
                at = next + end.unwrap_or(words.len() - next);
                at += usize::from(words.get(at).is_some_and(|word| word.text == ","));
            }
            return at + 1;
        }
        if !is_name(word.text) {
            break; // `*`, or the type arguments of `::<`
        }
        names.push(word.text);
        line = word.line;
        at += 1;
        if words.get(at).is_none_or(|word| word.text != "::") {
            break;
        }
        at += 1;
    }
    if names.last() == Some(&"self") {
        names.pop(); // `a::{self}` is `a`
    }
    if names.len() > 1 {
        found.push(CodePath { names, line });
    }
    at
}

fn is_name(text: &str) -> bool {
    text.starts_with(|c: char| c.is_alphabetic() || c == '_')
}

/// The absolute form of a path in `module`; `None` for paths into other crates and for types.
pub fn absolute(module: &[String], names: &[&str], is_module: impl Fn(&[String]) -> bool) -> Option<Module> {
    let owned = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>();
    match names {
        ["crate", rest @ ..] => Some(owned(rest)),
        ["self", rest @ ..] => Some([module.to_vec(), owned(rest)].concat()),
        ["super", ..] => {
            let climbed = names.iter().take_while(|name| **name == "super").count();
            let base = &module[..module.len().saturating_sub(climbed)];
            Some([base.to_vec(), owned(&names[climbed..])].concat())
        }
        [first, ..] => {
            let child = [module.to_vec(), owned(&[first])].concat();
            is_module(&child).then(|| [module.to_vec(), owned(names)].concat())
        }
        [] => None,
    }
}

/// The modules of a crate with the absolute paths that occur in each.
pub struct Imports(BTreeMap<Module, Vec<Module>>);

impl Imports {
    /// Of a crate's modules and their source texts.
    pub fn of(sources: &BTreeMap<Module, String>) -> Self {
        let is_module = |path: &[String]| sources.contains_key(path);
        let imported = |(module, text): (&Module, &String)| {
            let code = code(text);
            let words: Vec<Word<'_>> = words(&code).collect();
            let absolute =
                paths(&words).into_iter().filter_map(|path| absolute(module, &path.names, is_module));
            (module.clone(), absolute.collect())
        };
        Self(sources.iter().map(imported).collect())
    }

    /// The module that defines what a path names, through re-exports.
    fn definition(&self, path: &[String], re_exports: usize) -> Option<&Module> {
        let (length, (module, imported)) = (0..=path.len())
            .rev()
            .find_map(|length| Some((length, self.0.get_key_value(&path[..length])?)))?;
        let again = path.get(length).filter(|_| re_exports < 8).and_then(|name| {
            imported.iter().find(|other| other.last() == Some(name) && other.as_slice() != path)
        });
        again.and_then(|other| self.definition(other, re_exports + 1)).or(Some(module))
    }

    /// For each room, which of its modules import which others: `flow::track` imports
    /// `flow::template` if anything in the one names anything in the other.
    fn siblings(&self) -> BTreeMap<Module, BTreeMap<String, BTreeSet<String>>> {
        let mut rooms: BTreeMap<Module, BTreeMap<String, BTreeSet<String>>> = BTreeMap::new();
        for (module, imported) in &self.0 {
            for target in imported.iter().filter_map(|path| self.definition(path, 0)) {
                let common = module.iter().zip(target).take_while(|(a, b)| a == b).count();
                if let (Some(from), Some(to)) = (module.get(common), target.get(common)) {
                    let room = rooms.entry(module[..common].to_vec()).or_default();
                    room.entry(from.clone()).or_default().insert(to.clone());
                }
            }
        }
        rooms
    }

    /// Circles of imports between the modules of one room: the room, and the modules in order.
    pub fn circles(&self) -> Vec<(Module, Vec<String>)> {
        let mut circles = Vec::new();
        for (room, imports) in self.siblings() {
            let mut known = BTreeSet::new();
            for start in imports.keys() {
                if known.contains(start) {
                    continue;
                }
                if let Some(circle) = circle(&imports, start) {
                    known.extend(circle.iter().cloned());
                    circles.push((room.clone(), circle));
                }
            }
        }
        circles
    }
}

/// A shortest circle through `start`, if there is one.
pub fn circle(imports: &BTreeMap<String, BTreeSet<String>>, start: &String) -> Option<Vec<String>> {
    let mut routes = vec![vec![start.clone()]];
    let mut seen = BTreeSet::new();
    while !routes.is_empty() {
        let mut longer = Vec::new();
        for route in routes {
            for next in imports.get(route.last()?).into_iter().flatten() {
                if next == start {
                    return Some(route);
                }
                if seen.insert(next.clone()) {
                    longer.push([route.as_slice(), std::slice::from_ref(next)].concat());
                }
            }
        }
        routes = longer;
    }
    None
}
