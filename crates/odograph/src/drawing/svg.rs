//! Text for pictures and pages: numbers, escaping, embedded pictures.

use std::fmt::Write;

/// A coordinate in drawing units with one decimal, without trailing zeros; 0 if it is not finite.
pub fn coordinate(value: f64) -> String {
    if !value.is_finite() {
        return "0".into();
    }
    let text = format!("{value:.1}");
    let text = text.strip_suffix(".0").unwrap_or(&text);
    if text == "-0" { "0".into() } else { text.into() }
}

/// Text made safe between tags and inside quoted attributes of SVG and HTML. Characters that XML
/// forbids become `�`.
pub fn escape(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            '\t' | '\n' | '\r' => safe.push(character),
            '\0'..='\u{1f}' | '\u{7f}'..='\u{9f}' | '\u{fffe}' | '\u{ffff}' => safe.push('\u{fffd}'),
            _ => safe.push(character),
        }
    }
    safe
}

/// A `data:` URL with the bytes in base64 (RFC 4648, section 4).
pub fn data_uri(media_type: &str, bytes: &[u8]) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut uri = String::with_capacity(bytes.len().div_ceil(3) * 4 + 32);
    let _ = write!(uri, "data:{media_type};base64,");
    for group in bytes.chunks(3) {
        let byte = |i: usize| u32::from(group.get(i).copied().unwrap_or(0));
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for sextet in 0..4 {
            let letter = ALPHABET[(bits >> (18 - 6 * sextet) & 63) as usize];
            uri.push(if sextet > group.len() { '=' } else { char::from(letter) });
        }
    }
    uri
}

/// About how wide a text is in a sans-serif face of the given size, in the same unit: enough to
/// keep labels apart.
pub fn text_width(text: &str, size: f64) -> f64 {
    let of = |character: char| match character {
        'i' | 'j' | 'l' | 'I' | '.' | ',' | ':' | ';' | '\'' | '|' | ' ' => 0.3,
        'm' | 'w' | 'M' | 'W' | '@' => 0.88,
        'A'..='Z' => 0.68,
        '\0'..='\u{2fff}' => 0.56,
        _ => 1.0,
    };
    size * text.chars().map(of).sum::<f64>()
}

/// The text, with its middle left out if it would be wider than `width`.
pub fn fitted(text: &str, size: f64, width: f64) -> String {
    if text_width(text, size) <= width {
        return text.into();
    }
    let characters: Vec<char> = text.chars().collect();
    let mut keep = characters.len().min(400) / 2;
    loop {
        let head: String = characters[..keep].iter().collect();
        let tail: String = characters[characters.len() - keep..].iter().collect();
        let short = format!("{head}…{tail}");
        if keep == 0 || text_width(&short, size) <= width {
            return short;
        }
        keep -= 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_is_that_of_the_rfc() {
        for (plain, coded) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("fooba", "Zm9vYmE="),
        ] {
            assert_eq!(data_uri("x/y", plain.as_bytes()), format!("data:x/y;base64,{coded}"));
        }
    }

    #[test]
    fn markup_in_a_name_stays_text() {
        assert_eq!(escape("<b a='1'>&\u{1}"), "&lt;b a=&#39;1&#39;&gt;&amp;\u{fffd}");
    }

    #[test]
    fn long_titles_lose_their_middle() {
        let title = "a".repeat(5000) + "end";
        let short = fitted(&title, 20.0, 300.0);
        assert!(text_width(&short, 20.0) <= 300.0 && short.ends_with("end") && short.contains('…'));
        assert_eq!(fitted("drive", 20.0, 300.0), "drive");
    }

    #[test]
    fn coordinates_are_short() {
        assert_eq!(coordinate(-0.01), "0");
        assert_eq!(coordinate(12.0), "12");
        assert_eq!(coordinate(12.34), "12.3");
        assert_eq!(coordinate(f64::NAN), "0");
    }
}
