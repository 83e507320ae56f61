//! Tracks the chosen rows with one constant or branch overridden, for `bench/ablation.py`.

use crate::clip::Clip;
use crate::following::follow;
use crate::measuring::{against_exact_truth, times_lost};
use crate::rendering::render;
use crate::rows::BenchmarkRow;
use odograph::ablation::{CURRENT, FACTOR, REACHED};
use odograph::motion::MotionModel;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::BufRead;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;
use std::sync::atomic::Ordering::Relaxed;

/// Reads lines of an identity, a factor and indices of drives, and writes their figures as JSON.
pub fn main(names: &[String]) -> ExitCode {
    std::panic::set_hook(Box::new(|_| {}));
    let all: Vec<BenchmarkRow> = crate::rows::rows().into_iter().chain(crate::field::rows()).collect();
    let mut clips = Vec::new();
    for name in names {
        let (name, seed) = name.split_once(':').unwrap_or((name, "0"));
        let (Some(row), Ok(seed)) = (all.iter().find(|row| row.name == name), seed.parse()) else {
            eprintln!("no row {name}");
            return ExitCode::from(2);
        };
        let Ok(clip) = render(row, seed) else { return ExitCode::from(2) };
        clips.push((row.clone(), clip));
    }
    for (row, clip) in &clips {
        REACHED.iter().for_each(|one| one.store(0, Relaxed));
        let result = tracked(row, clip);
        let reached: Vec<u8> = REACHED.iter().map(|one| one.load(Relaxed)).collect();
        println!("{}", serde_json::json!({ "row": row.name, "result": result, "reached": reached }));
    }
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        let mut words = line.split_whitespace();
        let id: usize = words.next().and_then(|word| word.parse().ok()).unwrap_or(usize::MAX);
        let factor: f64 = words.next().and_then(|word| word.parse().ok()).unwrap_or(1.0);
        FACTOR.store(factor.to_bits(), Relaxed);
        CURRENT.store(id, Relaxed);
        let mut results = serde_json::Map::new();
        for at in words.filter_map(|word| word.parse::<usize>().ok()) {
            let (row, clip) = &clips[at];
            results.insert(row.name.to_owned(), tracked(row, clip));
        }
        CURRENT.store(usize::MAX, Relaxed);
        println!("{}", serde_json::Value::Object(results));
    }
    ExitCode::SUCCESS
}

/// The figures, with a hash of all poses and covariances.
fn tracked(row: &BenchmarkRow, clip: &Clip) -> serde_json::Value {
    let result = catch_unwind(AssertUnwindSafe(|| {
        let followed = follow(clip, row.follow, MotionModel::Auto)?;
        let mut hasher = DefaultHasher::new();
        for frame in &followed.frames {
            format!("{:?} {:?}", frame.status, frame.estimate).hash(&mut hasher);
        }
        let mut figures = against_exact_truth(clip, &followed)?;
        let posed = followed.frames.iter().filter(|frame| frame.estimate.is_some()).count();
        figures.set("posed_percent", 100.0 * posed as f64 / clip.frames.len().max(1) as f64);
        figures.set("lost", times_lost(&followed.frames) as f64);
        figures.set("restarts", followed.restarts as f64);
        figures.set("frame_ms", followed.times_ms.iter().sum::<f64>() / clip.frames.len().max(1) as f64);
        Ok::<_, odograph::error::Error>((figures, hasher.finish()))
    }));
    match result {
        Ok(Ok((figures, hash))) => {
            let mut value = serde_json::to_value(&figures).unwrap_or_default();
            value["hash"] = format!("{hash:x}").into();
            value
        }
        Ok(Err(error)) => serde_json::json!({ "error": error.to_string() }),
        Err(_) => serde_json::json!({ "error": "panic" }),
    }
}
