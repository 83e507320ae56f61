//! Calibrates from points detected by another program. Input is a text with `board …`, `size w h`,
//! and for each `view` its lines `index x y`.
//!
//! `cargo run --example solve_views -- points.txt [model [square] [centred] [bent]]` prints the
//! summary of `odograph calibrate` and the solving time.

#![allow(clippy::print_stdout)] // prints results

use odograph::error::{Error, Result};
use odograph::geometry::Pixel;
use odograph_calibration::{Board, BoardView, CalibrationConfig, SeenPoint, calibrate};
use std::time::Instant;

fn parse(text: &str) -> Option<(Board, Vec<BoardView>)> {
    let mut board = None;
    let mut size = (0, 0);
    let mut views: Vec<BoardView> = Vec::new();
    for line in text.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["board", name] => board = name.parse().ok(),
            ["size", width, height] => size = (width.parse().ok()?, height.parse().ok()?),
            ["view", ..] => views.push(BoardView { size, points: Vec::new() }),
            [index, x, y] => {
                let pixel = Pixel::new(x.parse().ok()?, y.parse().ok()?);
                views.last_mut()?.points.push(SeenPoint { index: index.parse().ok()?, pixel });
            }
            _ => {}
        }
    }
    Some((board?, views))
}

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let path = arguments.first().ok_or_else(|| Error::usage("give a file of points"))?;
    let text = std::fs::read_to_string(path).map_err(|error| Error::input(format!("{path}: {error}")))?;
    let (board, views) = parse(&text).ok_or_else(|| Error::input(format!("{path}: not a list of views")))?;
    let mut config = CalibrationConfig::default();
    for word in &arguments[1..] {
        match word.as_str() {
            "square" => config.square_pixels = true,
            "centred" => config.centred = true,
            "bent" => config.flat_board = false,
            model => config.model = Some(model.parse()?),
        }
    }
    let mut least_s = f64::INFINITY;
    for _ in 0..5 {
        let begun = Instant::now();
        calibrate(&board, &views, &config)?;
        least_s = least_s.min(begun.elapsed().as_secs_f64());
    }
    let found = calibrate(&board, &views, &config)?;
    println!("{} from {} of {} views", found.model, found.views_used(), found.views.len());
    println!(
        "rms {:.4} px, held out {:.4} px, noise {:.4} px, {:.1} ms",
        found.rms_px,
        found.hold_out_rms_px,
        found.noise_px,
        least_s * 1e3
    );
    for parameter in &found.parameters {
        println!("  {:8} {:12.6} ± {:.6}", parameter.name, parameter.value, parameter.deviation);
    }
    for candidate in &found.candidates {
        println!(
            "  {:16} rms {:.4} held out {:.4} expected error {:.3} px",
            candidate.model.name(),
            candidate.rms_px,
            candidate.hold_out_rms_px,
            candidate.expected_error_px
        );
    }
    for (number, view) in found.views.iter().enumerate() {
        if let Some(why) = &view.why_not {
            println!("  view {}: {why}", number + 1);
        }
    }
    println!("{}: {}", found.verdict, found.reasons.join("; "));
    Ok(())
}
