//! Processor time per frame on a recording, per stage and in total; `bench/opencv.py` compares it
//! with OpenCV's.
//!
//! ```console
//! $ cargo run --release -p odograph --example speed -- recording.y4m camera.yaml 0.9
//! ```
//!
//! Reads the luminance of a Y4M file, so that no decoder is involved, and prints one line of JSON:
//! milliseconds of processor time on one thread. With `--tracks` it also prints the tracked
//! positions of 500 corners in the next frame, and the poses, to compare accuracy. The pipeline
//! runs several times over the recording, and each frame counts with its minimum time, which
//! excludes other load of the machine. With `--passes N` it runs N times and measures nothing else,
//! for use with a profiler.

#![allow(clippy::print_stdout)]

use odograph::camera::{Camera, Rig};
use odograph::correction::{FieldOfViewKept, ImageCorrection};
use odograph::detection::{Corner, DetectionConfig, detect};
use odograph::error::{Error, Result};
use odograph::flow::{FlowConfig, Template, Warp, track};
use odograph::formats::camera_file;
use odograph::geometry::Pixel;
use odograph::image::{GrayImage, Pyramid};
use odograph::odometry::{Odometry, OdometryConfig};
use std::fmt::Write;
use std::hint::black_box;

/// Number of points, the same for both programs of the comparison.
const POINTS: usize = 500;

/// Interval between frames on which stages are measured.
const STRIDE: usize = 16;

/// Maximum number of frames on which stages are measured.
const STAGE_FRAMES: usize = 12;

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let [clip, camera, height, options @ ..] = words.as_slice() else {
        return Err(Error::usage("usage: speed CLIP.y4m CAMERA.yaml HEIGHT_M [--tracks] [--passes N]"));
    };
    let read = |path: &str| std::fs::read(path).map_err(|e| Error::input(format!("{path}: {e}")));
    let camera = camera_file::parse(&String::from_utf8_lossy(&read(camera)?), None)?;
    let height_m: f64 = height.parse().map_err(|_| Error::usage(format!("the height is {height}")))?;
    let (fps, frames) = luminance(&read(clip)?)?;
    let passes = options.iter().position(|o| o == "--passes").and_then(|i| options.get(i + 1));
    if let Some(passes) = passes.and_then(|passes| passes.parse().ok()) {
        let run = whole(&camera, height_m, &frames, fps, passes)?;
        let mut slowest: Vec<(usize, f64)> = run.times_ms.iter().copied().enumerate().collect();
        slowest.sort_by(|a, b| b.1.total_cmp(&a.1));
        slowest.truncate(12);
        println!("slowest frames (number, ms): {slowest:.2?}");
        let (mean, median, p99) = summary(run.times_ms);
        println!("mean {mean:.3} ms, median {median:.3} ms, p99 {p99:.3} ms, {} keyframes", run.keyframes);
        return Ok(());
    }
    let with_tracks = options.iter().any(|o| o == "--tracks");
    let stages = stages(&camera, &frames, with_tracks)?;
    let run = whole(&camera, height_m, &frames, fps, PASSES)?;
    let poses = if with_tracks { format!(", \"poses\": [{}]", run.poses.join(", ")) } else { String::new() };
    let (mean, median, p99) = summary(run.times_ms);
    println!(
        "{{\"frames\": {}, \"keyframes\": {}, \"lost\": {}, \"process\": {{\"mean_ms\": {mean:.4}, \"median_ms\": {median:.4}, \"p99_ms\": {p99:.4}}}, {stages}{poses}}}",
        frames.len(),
        run.keyframes,
        run.lost,
    );
    Ok(())
}

/// Processor time of this thread, which excludes other load of the machine. Wall-clock time on
/// systems without it.
struct ThreadClock(std::time::Duration);

impl ThreadClock {
    fn now() -> Self {
        #[cfg(unix)]
        {
            let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
            Self(std::time::Duration::new(time.tv_sec as u64, time.tv_nsec as u32))
        }
        #[cfg(not(unix))]
        {
            static START: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
            Self(START.get_or_init(std::time::Instant::now).elapsed())
        }
    }

    fn elapsed_ms(&self) -> f64 {
        1e3 * Self::now().0.saturating_sub(self.0).as_secs_f64()
    }
}

/// The luminance planes of a Y4M file with 8 bits per sample, and its frame rate.
fn luminance(bytes: &[u8]) -> Result<(f64, Vec<GrayImage>)> {
    let bad = |what: &str| Error::input(format!("not a Y4M file of 8 bits: {what}"));
    let end = bytes.iter().position(|&b| b == b'\n').ok_or_else(|| bad("no header"))?;
    let header = String::from_utf8_lossy(&bytes[..end]).into_owned();
    let field = |letter: char| header.split(' ').find_map(|word| word.strip_prefix(letter));
    let number = |letter| field(letter).and_then(|n| n.parse::<usize>().ok()).ok_or_else(|| bad("no size"));
    let (width, height) = (number('W')?, number('H')?);
    let rate = field('F').and_then(|rate| rate.split_once(':')).ok_or_else(|| bad("no rate"))?;
    let part = |text: &str| text.parse::<f64>().map_err(|_| bad("no rate"));
    let fps = part(rate.0)? / part(rate.1)?;
    let chroma = match field('C').unwrap_or("420") {
        "mono" => 0,
        kind if kind.starts_with("420") => 2 * width.div_ceil(2) * height.div_ceil(2),
        kind => return Err(bad(kind)),
    };
    let mut frames = Vec::new();
    let mut rest = &bytes[end + 1..];
    while let Some(line) = rest.iter().position(|&b| b == b'\n') {
        let Some(plane) = rest.get(line + 1..line + 1 + width * height) else { break };
        frames.extend(GrayImage::from_samples(width, height, plane.to_vec()));
        rest = rest.get(line + 1 + width * height + chroma..).unwrap_or_default();
    }
    if frames.len() < 2 { Err(bad("fewer than two frames")) } else { Ok((fps, frames)) }
}

/// Results of the whole pipeline over all frames.
struct Whole {
    times_ms: Vec<f64>,
    keyframes: u64,
    lost: usize,
    poses: Vec<String>,
}

/// Number of runs of the whole pipeline.
const PASSES: usize = 5;

fn whole(camera: &Camera, height_m: f64, frames: &[GrayImage], fps: f64, passes: usize) -> Result<Whole> {
    let mut best = pass(camera, height_m, frames, fps)?;
    for _ in 1..passes {
        let next = pass(camera, height_m, frames, fps)?;
        best.times_ms.iter_mut().zip(next.times_ms).for_each(|(best, next)| *best = best.min(next));
    }
    Ok(best)
}

fn pass(camera: &Camera, height_m: f64, frames: &[GrayImage], fps: f64) -> Result<Whole> {
    let mut odometry = Odometry::new(camera.clone(), Rig::level(height_m), OdometryConfig::default())?;
    let mut run = Whole { times_ms: Vec::new(), keyframes: 0, lost: 0, poses: Vec::new() };
    for (number, frame) in frames.iter().enumerate() {
        // A decoder would hand over ownership of the image, so the copy is not timed.
        let image = frame.clone();
        let start = ThreadClock::now();
        let found = odometry.process(image, number as f64 / fps)?;
        run.times_ms.push(start.elapsed_ms());
        match found.estimate {
            Some(known) => {
                let pose = known.pose;
                run.poses.push(format!("[{number}, {}, {}, {}]", pose.x_m, pose.y_m, pose.heading_rad));
            }
            None => run.lost += 1,
        }
    }
    run.keyframes = odometry.keyframes();
    Ok(run)
}

/// Median time of each stage, as JSON.
fn stages(camera: &Camera, frames: &[GrayImage], with_tracks: bool) -> Result<String> {
    let detection = DetectionConfig { corners: POINTS, minimum_distance_px: 10.0, ..Default::default() };
    let flow = FlowConfig::default();
    let correction = ImageCorrection::new(camera, FieldOfViewKept::SameFocalLength)?;
    let mut times: [(&str, Vec<f64>); 6] =
        ["undistort_image", "undistort_points", "pyramid", "corners", "templates", "lk"].map(|n| (n, vec![]));
    let mut tracks = String::new();
    let (mut asked, mut found) = (0, 0);
    for first in (0..frames.len() - 1).step_by(STRIDE).take(STAGE_FRAMES) {
        let image = &frames[first];
        let mut timed = |stage: usize, work: &mut dyn FnMut()| {
            // One run to warm up, then the best of three.
            work();
            let best = (0..3).map(|_| {
                let start = ThreadClock::now();
                work();
                start.elapsed_ms()
            });
            times[stage].1.push(best.fold(f64::INFINITY, f64::min));
        };
        timed(0, &mut || drop(black_box(correction.apply(image))));
        let mut pyramid = Pyramid::new(image.clone(), flow.levels);
        let mut next = Pyramid::new(frames[first + 1].clone(), flow.levels);
        let mut spare = Some(frames[first + 1].clone());
        timed(2, &mut || {
            if let Some(image) = spare.take() {
                spare = Some(next.replace(image));
                black_box(next.coarser());
            }
        });
        let mut corners: Vec<Corner> = Vec::new();
        timed(3, &mut || corners = detect(image, &detection, 9));
        let pixels: Vec<Pixel> = corners.iter().map(|c| Pixel::new(c.x as f64, c.y as f64)).collect();
        timed(1, &mut || {
            pixels.iter().for_each(|&pixel| {
                black_box(camera.ray_from_pixel(pixel));
            });
        });
        let mut templates: Vec<Template> = Vec::new();
        timed(4, &mut || {
            templates = corners.iter().filter_map(|c| Template::new(&pyramid, (c.x, c.y))).collect();
        });
        // Starts at the corners' previous positions, without motion prediction.
        let mut results = Vec::new();
        timed(5, &mut || {
            results.clear();
            results.extend(templates.iter().map(|template| {
                let start = Warp::translation(template.centre());
                track(template, &next, &start, f64::INFINITY, &flow)
            }));
        });
        asked += templates.len();
        for (template, result) in templates.iter().zip(&results) {
            let Ok(track) = result else { continue };
            if track.dissimilarity > flow.dissimilarity {
                continue;
            }
            found += 1;
            if with_tracks {
                let (from, to) = (template.centre(), track.position);
                let comma = if tracks.is_empty() { "" } else { ", " };
                let _ = write!(tracks, "{comma}[{first}, {}, {}, {}, {}]", from.x, from.y, to.x, to.y);
            }
        }
        pyramid.replace(image.clone());
    }
    let mut text = String::from("\"stages_ms\": {");
    for (index, (name, times)) in times.into_iter().enumerate() {
        let comma = if index == 0 { "" } else { ", " };
        let _ = write!(text, "{comma}\"{name}\": {:.4}", summary(times).1);
    }
    let _ = write!(text, "}}, \"points\": {asked}, \"points_found\": {found}");
    if with_tracks {
        let _ = write!(text, ", \"tracks\": [{tracks}]");
    }
    Ok(text)
}

/// Mean, median and 99th percentile.
fn summary(mut values: Vec<f64>) -> (f64, f64, f64) {
    values.sort_unstable_by(f64::total_cmp);
    let count = values.len().max(1);
    let at = |index: usize| values.get(index.min(count - 1)).copied().unwrap_or(0.0);
    (values.iter().sum::<f64>() / count as f64, at(count / 2), at(count * 99 / 100))
}
