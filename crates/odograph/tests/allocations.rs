//! Tracking a frame between keyframes allocates no memory: buffers are allocated once and reused.
//! The smoother needs a constant number of values per frame.
//!
//! This test is a separate binary because the counting allocator is global to the program.

#![allow(unsafe_code)] // a global allocator needs unsafe code
#![allow(clippy::unwrap_used)]

use nalgebra::Matrix6;
use odograph::camera::{Camera, Rig};
use odograph::filter::{Carrier, FilterConfig, Smoother};
use odograph::geometry::GroundPose;
use odograph::image::GrayImage;
use odograph::odometry::{Odometry, OdometryConfig};
use odograph::trajectory::{
    FrameEstimate, FrameSummary, PlaneMeasurement, PoseEstimate, TrackStatus, Velocity,
};
use odograph_simulation::{Ground, Renderer, Texture};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

/// The system allocator with counters for this thread.
struct CountingAllocator;

thread_local! {
    static ASKED: Cell<usize> = const { Cell::new(0) };
    /// Bytes currently allocated by this thread, and their maximum.
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

// SAFETY: all calls are forwarded unchanged to the system allocator.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size(), 0);
        // SAFETY: the caller's guarantees are those that the system allocator requires.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        count(0, layout.size());
        // SAFETY: the caller's guarantees are those that the system allocator requires.
        unsafe { System.dealloc(memory, layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(size, layout.size());
        // SAFETY: the caller's guarantees are those that the system allocator requires.
        unsafe { System.realloc(memory, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

const HEIGHT_M: f64 = 0.75;

/// A drive with 1 cm per frame. With 0.72 m of ground in view, about every thirtieth frame is a
/// keyframe.
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
fn tracking_between_keyframes_allocates_nothing() {
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
    // The first frames allocate the buffers, the last of them for the third image in the search for
    // fixed-pattern noise. A keyframe retains the images of its frame, so the two frames after it
    // allocate new ones and prepare the keyframe.
    let steady: Vec<usize> = (17..counts.len())
        .filter(|&number| counts[number - 2..=number].iter().all(|&(_, keyframe)| !keyframe))
        .map(|number| counts[number].0)
        .collect();
    assert!(steady.len() > 60, "{} frames between keyframes", steady.len());
    assert!(steady.iter().all(|&asked| asked == 0), "{steady:?}, all with keyframes: {counts:?}");
    // The second frame after a keyframe has almost nothing left to allocate.
    let second = (5..counts.len()).filter(|&number| counts[number - 2].1).map(|number| counts[number].0);
    assert!(second.max().is_some_and(|asked| asked <= 3), "{counts:?}");
}

#[test]
fn smoothing_needs_a_few_numbers_per_frame() {
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
    let mut carrier = Carrier::for_frames(&Rig::level(HEIGHT_M), FRAMES);
    let mut walk = path.walk();
    (0..FRAMES).for_each(|number| walk.next(&frame(number), &mut |smoothed| carrier.push(&smoothed)));
    drop(walk);
    drop(path);
    assert_eq!(carrier.path().count(), FRAMES);
    let most = (MOST.get() - before) as f64 / FRAMES as f64;
    // Per frame: the time; measurement, variance and validity of three axes; for one axis at a
    // time, the smoothed state and the change of the process noise.
    let needed = 8.0 + 3.0 * 24.0 + (2.0 * 32.0 + 8.0);
    assert!(most < needed + 8.0, "{most} bytes a frame");
    assert!(HELD.get() - before < 1000, "{} bytes stay", HELD.get() - before);
    // The values for drawings, charts and statistics are at most a quarter of a frame estimate; an
    // hour has about 100,000 frames.
    assert!(size_of::<FrameSummary>() <= 120 && size_of::<FrameEstimate>() >= 4 * size_of::<FrameSummary>());
}
