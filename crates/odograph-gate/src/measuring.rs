//! Measures rows in parallel.

use crate::arguments::GateArguments;
use crate::baseline::{GateResults, RowFigures, Skipped};
use crate::clip::Clip;
use crate::figures::Figures;
use crate::following::{TrackedClip, follow};
use crate::processor::peak_memory_mb;
use crate::recordings::{self, RealRecording};
use crate::rendering::render;
use crate::rows::BenchmarkRow;
use nalgebra::Vector3;
use odograph::error::Result;
use odograph::evaluation::{Alignment, EvaluationOptions, evaluate};
use odograph::geometry::pose_index::{X, Y};
use odograph::geometry::{GroundPose, wrap_angle};
use odograph::motion::MotionModel;
use odograph::trajectory::{FrameEstimate, TrackStatus, Trajectory};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Frames left out of the NEES: the first pose is exact by definition.
const SETTLED_FRAMES: usize = 30;

/// A clip to be measured.
enum Job {
    Rendered { row: Box<BenchmarkRow>, seed: u64 },
    Real(RealRecording),
}

/// Measures all selected rows; real recordings only if their data is available.
pub fn measure(arguments: &GateArguments) -> GateResults {
    let mut measured = GateResults::default();
    let jobs = jobs(arguments, &mut measured.skipped);
    (measured.rows, measured.failed) = measure_rows(arguments, &jobs, arguments.thread_count());
    let mut process = Figures::default();
    // Peak memory is only comparable with all rows and the default threads, hence the same clips in
    // memory.
    if arguments.words.is_empty() && arguments.threads.is_none() && arguments.seeds.is_none() {
        peak_memory_mb().into_iter().for_each(|megabytes| process.set("peak_memory_mb", megabytes));
    }
    measured.process = Figures::over_seeds(&[process]);
    measured
}

/// Measures the rows of those names again, one after the other, and keeps the shorter times.
/// Processor time counts what a virtual machine's host or a shared core takes away, so a row that
/// is slow in one run may only have been disturbed.
pub fn measure_times_again(arguments: &GateArguments, measured: &mut GateResults, names: &[&str]) {
    let mut jobs = jobs(arguments, &mut Vec::new());
    jobs.retain(|(name, _)| names.contains(&name.as_str()));
    for again in measure_rows(arguments, &jobs, 1).0 {
        for row in measured.rows.iter_mut().filter(|row| row.name == again.name) {
            row.figures.keep_shorter_times(&again.figures);
        }
    }
}

/// The clips of all selected rows.
fn jobs(arguments: &GateArguments, skipped: &mut Vec<Skipped>) -> Vec<(String, Job)> {
    let mut jobs: Vec<(String, Job)> = Vec::new();
    let data = recordings::folder();
    for recording in recordings::all() {
        if arguments.field || !arguments.asks_for(recording.name) {
            continue;
        }
        let there = data.join(recording.name).is_dir();
        if there {
            jobs.push((recording.name.to_owned(), Job::Real(recording)));
        } else {
            let reason = format!("no {}", data.display());
            skipped.push(Skipped { name: recording.name.to_owned(), reason });
        }
    }
    for row in arguments.rows() {
        let seeds = arguments.seeds.unwrap_or(row.seeds);
        for seed in arguments.first_seed..arguments.first_seed + seeds {
            jobs.push((row.name.to_owned(), Job::Rendered { row: Box::new(row.clone()), seed }));
        }
    }
    jobs
}

/// The results of the clips' rows, and the rows that ended with an error.
fn measure_rows(
    arguments: &GateArguments,
    jobs: &[(String, Job)],
    threads: usize,
) -> (Vec<RowFigures>, Vec<Skipped>) {
    let (mut rows, mut failed) = (Vec::new(), Vec::new());
    let results = in_parallel(jobs, threads);
    let mut names: Vec<&str> = jobs.iter().map(|(name, _)| name.as_str()).collect();
    names.dedup();
    for name in names {
        let of_row = || results.iter().filter(|(row, _)| row == name).map(|(_, result)| result);
        if let Some(error) = of_row().find_map(|result| result.as_ref().err()) {
            failed.push(Skipped { name: name.to_owned(), reason: error.clone() });
            continue;
        }
        let figures: Vec<Figures> = of_row().flatten().cloned().collect();
        rows.push(RowFigures {
            name: name.to_owned(),
            first_seed: arguments.first_seed,
            seeds: figures.len() as u64,
            figures: Figures::over_seeds(&figures),
        });
    }
    (rows, failed)
}

/// The results of all jobs, or the errors, in the order of the jobs.
fn in_parallel(
    jobs: &[(String, Job)],
    threads: usize,
) -> Vec<(String, std::result::Result<Figures, String>)> {
    let results = Mutex::new(vec![None; jobs.len()]);
    let next = AtomicUsize::new(0);
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some((name, job)) = jobs.get(index) else { break };
                    let figures = figures_of(job).map_err(|error| error.to_string());
                    if let Ok(mut results) = results.lock() {
                        results[index] = Some((name.clone(), figures));
                    }
                }
            });
        }
    });
    results.into_inner().unwrap_or_default().into_iter().flatten().collect()
}

fn figures_of(job: &Job) -> Result<Figures> {
    let (clip, followed, mut figures) = match job {
        Job::Rendered { row, seed } => {
            let clip = render(row, *seed)?;
            let followed = follow(&clip, row.follow, MotionModel::Auto)?;
            let figures = against_exact_truth(&clip, &followed)?;
            (clip, followed, figures)
        }
        Job::Real(recording) => {
            let clip = recording.open(&recordings::folder())?;
            let followed = follow(&clip, recording.follow, recording.model)?;
            let mut figures = Figures::default();
            figures.set("ate_mm", ate_mm(&clip, &followed, recording.alignment)?);
            (clip, followed, figures)
        }
    };
    let posed = followed.frames.iter().filter(|frame| frame.estimate.is_some()).count();
    figures.set("posed_percent", 100.0 * posed as f64 / clip.frames.len().max(1) as f64);
    figures.set("lost", times_lost(&followed.frames) as f64);
    figures.set("restarts", followed.restarts as f64);
    let mut times_ms = followed.times_ms;
    times_ms.sort_by(f64::total_cmp);
    let mean_ms = times_ms.iter().sum::<f64>() / times_ms.len().max(1) as f64;
    let p99_ms = times_ms.get(times_ms.len() * 99 / 100).copied().unwrap_or(f64::NAN);
    figures.set("frame_ms", mean_ms);
    let reference_ms = followed.reference.mean_ms();
    figures.set("reference_ms", reference_ms);
    figures.set("frame_ratio", mean_ms / reference_ms);
    figures.set("p99_ratio", p99_ms / mean_ms);
    Ok(figures)
}

/// Number of losses: intervals without a pose, not frames.
fn times_lost(frames: &[FrameEstimate]) -> usize {
    let is_lost = |frame: &FrameEstimate| matches!(frame.status, TrackStatus::Lost { .. });
    let begins = frames.windows(2).filter(|pair| !is_lost(&pair[0]) && is_lost(&pair[1])).count();
    begins + usize::from(frames.first().is_some_and(is_lost))
}

/// Absolute trajectory error (RMSE of the translation), millimetres.
fn ate_mm(clip: &Clip, followed: &TrackedClip, alignment: Alignment) -> Result<f64> {
    let options = EvaluationOptions { alignment, ..EvaluationOptions::default() };
    let found = evaluate(&Trajectory::from_frames(&followed.frames), &clip.truth, &options)?;
    Ok(1e3 * found.absolute.translation.rmse)
}

/// Measures that need exact ground truth in the same world frame.
fn against_exact_truth(clip: &Clip, followed: &TrackedClip) -> Result<Figures> {
    let options = EvaluationOptions {
        alignment: Alignment::Origin,
        segment_lengths_m: vec![1.0],
        ..EvaluationOptions::default()
    };
    let found = evaluate(&Trajectory::from_frames(&followed.frames), &clip.truth, &options)?;
    let mut figures = Figures::default();
    if let Some(drift) = found.drift.first() {
        figures.set("drift_percent", drift.translation_percent);
        figures.set("heading_deg_per_m", drift.heading_deg_per_m);
    }
    figures.set("end_mm", 1e3 * found.final_position_error_m);
    if let Some(last) = followed.frames.iter().rev().find_map(|frame| frame.estimate.as_ref()) {
        let variance_m2 = last.covariance[(X, X)] + last.covariance[(Y, Y)];
        figures.set("end_sigma_mm", 1e3 * variance_m2.sqrt());
    }
    figures.set("nees", nees(clip, &followed.frames));
    Ok(figures)
}

/// Normalised estimation error squared (NEES) of x, y and heading, averaged over the frames; its
/// expected value is 3 if the covariance is consistent.
fn nees(clip: &Clip, frames: &[FrameEstimate]) -> f64 {
    let (mut sum, mut count) = (0.0, 0usize);
    for (frame, truth) in frames.iter().zip(&clip.truth.poses).skip(SETTLED_FRAMES) {
        let Some(known) = &frame.estimate else { continue };
        let truth = GroundPose::from_world_from_camera(&truth.world_from_camera);
        let error = Vector3::new(
            known.pose.x_m - truth.x_m,
            known.pose.y_m - truth.y_m,
            wrap_angle(known.pose.heading_rad - truth.heading_rad),
        );
        let covariance = known.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        if let Some(information) = covariance.try_inverse() {
            sum += error.dot(&(information * error));
            count += 1;
        }
    }
    sum / count as f64
}
