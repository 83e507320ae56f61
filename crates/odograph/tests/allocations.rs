//! Between keyframes a frame is followed without a single allocation: memory is taken once, and used again. What a whole recording is smoothed in is a few
//! numbers a frame.
//!
//! A binary of its own, because the allocator that counts is the whole program's.

#![allow(unsafe_code)] // an allocator is made of it
#![allow(clippy::unwrap_used)]

use nalgebra::Matrix6;
use odograph::camera::{Camera, Rig};
use odograph::filter::{Carrier, FilterConfig, Smoother};
use odograph::geometry::GroundPose;
use odograph::image::GrayImage;
use odograph::odometry::{Odometry, OdometryConfig};
use odograph::simulation::{Ground, Renderer, Texture};
use odograph::trajectory::{
    FrameEstimate, FrameSummary, PlaneMeasurement, PoseEstimate, TrackStatus, Velocity,
};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

/// The system's allocator, counting what this thread asks of it.
struct Counting;

thread_local! {
    static ASKED: Cell<usize> = const { Cell::new(0) };
    /// Bytes that this thread has, and the most that it had.
    static HELD: Cell<isize> = const { Cell::new(0) };
    static MOST: Cell<isize> = const { Cell::new(0) };
}

fn count(more: usize, less: usize) {
    let _ = ASKED.try_with(|asked| asked.set(asked.get() + usize::from(more > 0)));
    let held = HELD.try_with(|held| {
        held.set(held.get() + more as isize - less as isize);
        held.get()
    });
    let _ = MOST.try_with(|most| most.set(most.get().max(held.unwrap_or(0))));
}

// SAFETY: every call is passed on to the system's allocator as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size(), 0);
        // SAFETY: the caller's promises are the system's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        count(0, layout.size());
        // SAFETY: the caller's promises are the system's.
        unsafe { System.dealloc(memory, layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(size, layout.size());
        // SAFETY: the caller's promises are the system's.
        unsafe { System.realloc(memory, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const HEIGHT_M: f64 = 0.75;

/// A drive of 1 cm a frame: at 0.72 m of ground in view there is a new keyframe every thirty frames or so.
fn drive(frames: usize) -> (Camera, Vec<GrayImage>) {
    let camera = Camera::from_field_of_view((320, 240), (0.96, 0.72), HEIGHT_M).unwrap();
    let renderer = Renderer::new(&camera);
    let footprint_m = renderer.footprint_m(HEIGHT_M);
    let ground = Ground::new(Texture::named("asphalt").unwrap(), footprint_m, false, 3).unwrap();
    let pose = |number| GroundPose { x_m: 0.01 * number as f64, ..GroundPose::level(HEIGHT_M) };
    let images = (0..frames).map(|number| renderer.gray_view(&ground, &pose(number))).collect();
    (camera, images)
}

#[test]
fn between_keyframes_a_frame_allocates_nothing() {
    let (camera, images) = drive(90);
    let mut odometry = Odometry::new(camera, Rig::level(HEIGHT_M), OdometryConfig::default()).unwrap();
    let mut counts = Vec::with_capacity(images.len());
    for (number, image) in images.into_iter().enumerate() {
        let before = ASKED.get();
        let frame = odometry.process(image, number as f64 / 30.0).unwrap();
        counts.push((ASKED.get() - before, frame.keyframe));
        assert!(frame.estimate.is_some(), "frame {number}: {:?}", frame.status);
    }
    assert!(odometry.keyframes() >= 3, "{} keyframes", odometry.keyframes());
    // The first frames take the memory; and the two frames after a keyframe, whose images the keyframe keeps, take those of the next and prepare it.
    let steady: Vec<usize> = (5..counts.len())
        .filter(|&number| counts[number - 2..=number].iter().all(|&(_, keyframe)| !keyframe))
        .map(|number| counts[number].0)
        .collect();
    assert!(steady.len() > 60, "{} frames between keyframes", steady.len());
    assert!(steady.iter().all(|&asked| asked == 0), "{steady:?}, all with keyframes: {counts:?}");
    // The second of those two has next to nothing left to ask for.
    let second = (5..counts.len()).filter(|&number| counts[number - 2].1).map(|number| counts[number].0);
    assert!(second.max().is_some_and(|asked| asked <= 3), "{counts:?}");
}

#[test]
fn an_hour_is_smoothed_and_shown_in_a_few_numbers_a_frame() {
    const FRAMES: usize = 20_000;
    let pose = |number: usize| GroundPose { x_m: 0.01 * number as f64, ..GroundPose::level(HEIGHT_M) };
    let frame = |number: usize| {
        let covariance = Matrix6::identity() * 1e-8;
        let (pose, measured) = (pose(number), PlaneMeasurement::new(&pose(number), &covariance));
        FrameEstimate {
            frame: number as u64,
            time_s: number as f64 / 30.0,
            status: TrackStatus::Tracked,
            estimate: Some(PoseEstimate { pose, velocity: Velocity::default(), covariance, measured }),
            tracks: 200,
            inliers: 200,
            residual_px: 0.1,
            keyframe: false,
            segment: 0,
        }
    };
    let before = HELD.get();
    MOST.set(before);
    let mut smoother = Smoother::for_frames(FRAMES);
    (0..FRAMES).for_each(|number| smoother.push(&frame(number)));
    let path = smoother.smoothed(&FilterConfig::default());
    let mut carrier = Carrier::for_frames(FRAMES);
    let mut walk = path.walk();
    (0..FRAMES).for_each(|number| walk.next(&frame(number), &mut |smoothed| carrier.push(&smoothed)));
    drop(walk);
    drop(path);
    assert_eq!(carrier.path(&Rig::level(HEIGHT_M)).count(), FRAMES);
    let most = (MOST.get() - before) as f64 / FRAMES as f64;
    // A time, what was measured on three axes, with its variance and whether it was; and, of one axis, what it comes out as and how much the jerk changes.
    let needed = 8.0 + 3.0 * 24.0 + (2.0 * 32.0 + 8.0);
    assert!(most < needed + 8.0, "{most} bytes a frame");
    assert!(HELD.get() - before < 1000, "{} bytes stay", HELD.get() - before);
    // What drawings, charts and figures are made of: a fifth of a whole frame, of which an hour has a hundred thousand.
    assert!(size_of::<FrameSummary>() <= 120 && size_of::<FrameEstimate>() >= 4 * size_of::<FrameSummary>());
}
