//! A view of Rust source code without comments, literals and test code.

/// A token of the code and its line number, counted from 1.
#[derive(Debug, Clone, Copy)]
pub struct Word<'a> {
    pub text: &'a str,
    pub line: usize,
}

/// Splits code into tokens: names, `::`, and all other characters one by one.
pub fn words(code: &str) -> impl Iterator<Item = Word<'_>> {
    let (mut at, mut line) = (0, 1);
    std::iter::from_fn(move || {
        loop {
            let first = code[at..].chars().next()?;
            if !first.is_whitespace() {
                break;
            }
            line += usize::from(first == '\n');
            at += first.len_utf8();
        }
        let rest = &code[at..];
        let name = rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len());
        let length = match name {
            0 if rest.starts_with("::") => 2,
            0 => rest.chars().next()?.len_utf8(),
            n => n,
        };
        at += length;
        Some(Word { text: &rest[..length], line })
    })
}

/// The code of a source text. Removed parts become blanks, and line numbers are preserved.
pub fn code(source: &str) -> String {
    without_tests(&without_comments_and_quotes(source))
}

fn without_comments_and_quotes(source: &str) -> String {
    let mut kept = String::with_capacity(source.len());
    let mut rest = source;
    while let Some(first) = rest.chars().next() {
        let after_name = kept.ends_with(|c: char| c.is_alphanumeric() || c == '_');
        let skipped = match first {
            '/' if rest.starts_with("//") => rest.find('\n').unwrap_or(rest.len()),
            '/' if rest.starts_with("/*") => block_comment(rest),
            '"' => quoted(rest),
            'r' if !after_name => raw_quoted(rest).unwrap_or(0),
            '\'' => character(rest).unwrap_or(0),
            _ => 0,
        };
        if skipped == 0 {
            kept.push(first);
            rest = &rest[first.len_utf8()..];
        } else {
            // A blank separates the tokens before and after the removed part.
            kept.push(' ');
            kept.extend(rest[..skipped].chars().filter(|&c| c == '\n'));
            rest = &rest[skipped..];
        }
    }
    kept
}

/// Length of the block comment at the start of `text`; block comments may be nested.
fn block_comment(text: &str) -> usize {
    let (mut depth, mut at) = (0, 0);
    while at < text.len() {
        if text[at..].starts_with("/*") {
            (depth, at) = (depth + 1, at + 2);
        } else if text[at..].starts_with("*/") {
            (depth, at) = (depth - 1, at + 2);
            if depth == 0 {
                return at;
            }
        } else {
            at += text[at..].chars().next().map_or(1, char::len_utf8);
        }
    }
    text.len()
}

/// Length of the string literal at the start of `text`.
fn quoted(text: &str) -> usize {
    let mut escaped = false;
    for (at, c) in text.char_indices().skip(1) {
        match c {
            _ if escaped => escaped = false,
            '\\' => escaped = true,
            '"' => return at + 1,
            _ => {}
        }
    }
    text.len()
}

/// Length of the raw string literal (`r"…"`, `r#"…"#`) at the start of `text`, if there is one.
fn raw_quoted(text: &str) -> Option<usize> {
    let hashes = text[1..].bytes().take_while(|&b| b == b'#').count();
    let body = text[1 + hashes..].strip_prefix('"')?;
    let end = format!("\"{}", "#".repeat(hashes));
    let begin = text.len() - body.len();
    Some(body.find(&end).map_or(text.len(), |at| begin + at + end.len()))
}

/// Length of the character literal at the start of `text`; `None` for a lifetime.
fn character(text: &str) -> Option<usize> {
    let mut characters = text.char_indices().skip(1);
    if characters.next()?.1 == '\\' {
        characters.next()?;
        return Some(characters.find(|&(_, c)| c == '\'')?.0 + 1);
    }
    let (at, end) = characters.next()?;
    (end == '\'').then_some(at + 1)
}

/// Removes each item under `#[cfg(test)]`, up to its closing brace or its semicolon.
fn without_tests(code: &str) -> String {
    const MARK: &str = "#[cfg(test)]";
    let mut kept = String::with_capacity(code.len());
    let mut rest = code;
    while let Some(mark) = rest.find(MARK) {
        kept.push_str(&rest[..mark]);
        let item = &rest[mark + MARK.len()..];
        let (mut depth, mut end) = (0, item.len());
        for (at, c) in item.char_indices() {
            match c {
                '{' => depth += 1,
                '}' => depth -= 1,
                _ => {}
            }
            // `use crate::{a, b};` ends with its semicolon, `mod tests { … }` with its brace.
            let whole = c == ';' && depth == 0;
            let is_use = item.trim_start().starts_with("use") || item.trim_start().starts_with("pub use");
            if whole || (c == '}' && depth == 0 && !is_use) {
                end = at + 1;
                break;
            }
        }
        kept.extend(item[..end].chars().filter(|&c| c == '\n'));
        rest = &item[end..];
    }
    kept + rest
}
