//! Between keyframes a frame is followed without a single allocation: memory is taken once, and used again.
//!
//! A binary of its own, because the allocator that counts is the whole program's.

#![allow(unsafe_code)] // an allocator is made of it
#![allow(clippy::unwrap_used)]

use odograph::camera::{Camera, Rig};
use odograph::geometry::GroundPose;
use odograph::image::GrayImage;
use odograph::odometry::{Odometry, OdometryConfig};
use odograph::simulation::{Ground, Renderer, Texture};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

/// The system's allocator, counting what this thread asks of it.
struct Counting;

thread_local! {
    static ASKED: Cell<usize> = const { Cell::new(0) };
}

fn count() {
    let _ = ASKED.try_with(|asked| asked.set(asked.get() + 1));
}

// SAFETY: every call is passed on to the system's allocator as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are the system's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: the caller's promises are the system's.
        unsafe { System.dealloc(memory, layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
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
    // The first frames take the memory; and a frame after a keyframe, whose images the keyframe keeps, takes those of the next.
    let steady: Vec<usize> = (5..counts.len())
        .filter(|&number| !counts[number].1 && !counts[number - 1].1)
        .map(|number| counts[number].0)
        .collect();
    assert!(steady.len() > 60, "{} frames between keyframes", steady.len());
    assert!(steady.iter().all(|&asked| asked == 0), "{steady:?}, all with keyframes: {counts:?}");
}
