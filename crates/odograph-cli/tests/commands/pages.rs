//! The colours of the pages.

use std::collections::BTreeMap;
use std::path::Path;

/// Least ratio of luminances of a text and its ground (WCAG 2.1, level AA).
const LEAST: f64 = 4.5;

/// The variables of a style sheet, in the light and in the dark theme.
fn themes(sheet: &str) -> [BTreeMap<String, String>; 2] {
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(sheet)).unwrap();
    let mut blocks = text.split(":root {").skip(1).map(|rest| rest.split('}').next().unwrap());
    let variables = |block: &str| -> BTreeMap<String, String> {
        let pairs = block.split(';').filter_map(|line| line.trim().strip_prefix("--")?.split_once(':'));
        pairs.map(|(name, value)| (name.to_owned(), value.trim().to_owned())).collect()
    };
    let light = variables(blocks.next().unwrap());
    let mut dark = light.clone();
    dark.extend(variables(blocks.next().unwrap()));
    [light, dark]
}

/// Relative luminance of a colour such as `#1b2430`.
fn luminance(color: &str) -> f64 {
    let part = |at: usize| {
        let value = f64::from(u8::from_str_radix(&color[at..at + 2], 16).unwrap()) / 255.0;
        if value <= 0.03928 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
    };
    0.2126 * part(1) + 0.7152 * part(3) + 0.0722 * part(5)
}

#[test]
fn words_of_the_pages_stand_out_from_their_ground_in_both_themes() {
    let report = ("odograph-report/src/style.css", &["ink", "muted", "blue"][..], &["page", "card"][..]);
    let live = (
        "odograph-live/src/page/style.css",
        &["ink", "soft", "accent", "good", "bad", "warn"][..],
        &["card"][..],
    );
    let buttons = ("odograph-live/src/page/style.css", &["on-accent"][..], &["accent"][..]);
    for (sheet, words, grounds) in [report, live, buttons] {
        for theme in themes(sheet) {
            for (word, ground) in
                words.iter().flat_map(|word| grounds.iter().map(move |ground| (word, ground)))
            {
                let [a, b] = [&theme[*word], &theme[*ground]].map(|color| luminance(color) + 0.05);
                let ratio = a.max(b) / a.min(b);
                assert!(ratio >= LEAST, "{sheet}: {word} on {ground} has a contrast of {ratio:.2}");
            }
        }
    }
}

#[test]
fn words_of_a_key_have_the_colour_of_text() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../odograph-report/src/style.css");
    let text = std::fs::read_to_string(path).unwrap();
    let keys: Vec<&str> = text.lines().filter(|line| line.starts_with(".key.")).collect();
    assert!(keys.len() >= 4 && keys.iter().all(|line| !line.contains(" color:")), "{keys:?}");
}

#[test]
fn the_page_of_a_site_draws_paths_over_loops() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../odograph-site/src/page/site.js");
    let text = std::fs::read_to_string(path).unwrap();
    let place = |what: &str| text.find(what).unwrap_or_else(|| panic!("{what} is not drawn"));
    assert!(place("of state.loops) line(") < place("line(session.path)"));
}
