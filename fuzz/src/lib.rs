//! What the fuzz targets share: files in memory, recordings decoded to their end.
//!
//! A target fails by a panic, by taking longer than the time limit, or by exceeding the memory
//! limit. Panics of third-party decoders that become errors are no failures, but are listed; those
//! of our own code are failures even where they would become errors.

use nalgebra::{Matrix4, Matrix6, Vector4};
use odograph::camera::{Camera, Distortion, Rig};
use odograph::filter::fusion::SensorKind;
use odograph::geometry::GroundPose;
use odograph::ground_map::{KeyframeImage, MapKeyframe};
use odograph::image::GrayImage;
use odograph::keyframe::{EdgeKind, KeyframeId, MapEdge};
use odograph::place_recognition::{GroundFeature, Signature};
use odograph_map::{MapFile, PathFrame};
use odograph_video::{Picture, SourceOptions, open};
use std::alloc::{GlobalAlloc, Layout, System};
use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, Once};

/// Most memory in use at any time, bytes: 17 frames of 36 megapixels with their chroma, which a
/// video decoder may hold, and the copies of a picture while it is converted.
const MAX_IN_USE: usize = 2 << 30;

/// The system allocator, which ends the process when more than [`MAX_IN_USE`] is in use: the limit
/// of libFuzzer misses memory that is never written or soon given back.
struct BoundedAllocator;

static IN_USE: AtomicUsize = AtomicUsize::new(0);

fn claim(size: usize) {
    let before = IN_USE.fetch_add(size, Ordering::Relaxed);
    if before < MAX_IN_USE && size >= MAX_IN_USE - before {
        // What the report itself allocates is above the limit already, and is not checked again.
        end(&format!("{size} bytes were asked for while {before} were in use"));
    }
}

/// Ends the process with a message and the place it comes from.
fn end(message: &str) -> ! {
    eprintln!("{message}\n{}", std::backtrace::Backtrace::force_capture());
    std::process::abort();
}

fn give_back(size: usize) {
    IN_USE.fetch_sub(size, Ordering::Relaxed);
}

// SAFETY: all calls are forwarded unchanged to the system allocator.
unsafe impl GlobalAlloc for BoundedAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        claim(layout.size());
        // SAFETY: the caller's guarantees are those that the system allocator requires.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        claim(layout.size());
        // SAFETY: the caller's guarantees are those that the system allocator requires.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        give_back(layout.size());
        // SAFETY: the caller's guarantees are those that the system allocator requires.
        unsafe { System.dealloc(memory, layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        claim(size);
        give_back(layout.size());
        // SAFETY: the caller's guarantees are those that the system allocator requires.
        unsafe { System.realloc(memory, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: BoundedAllocator = BoundedAllocator;

/// Makes panics of our own code failures where `odograph-video` would make errors of them, and
/// lists the places of all others.
fn judge_panics() {
    static ONCE: Once = Once::new();
    static LISTED: Mutex<Option<HashSet<String>>> = Mutex::new(None);
    ONCE.call_once(|| {
        // Its own hook is installed by the first call, and must be below this one.
        let _ = Picture::from_jpeg(&[], false);
        let hook = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            let place = info.location().map(ToString::to_string).unwrap_or_default();
            if place.contains("crates/odograph") {
                end(&info.to_string());
            }
            hook(info);
            if let Ok(mut listed) = LISTED.lock()
                && listed.get_or_insert_default().insert(place.clone())
            {
                eprintln!("contained: {place}");
            }
        }));
    });
}

/// A file of this process in memory, where the system has a place for that.
pub fn scratch(name: &str) -> PathBuf {
    let memory = Path::new("/dev/shm");
    let folder = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
    folder.join(format!("odograph-fuzz-{}-{name}", std::process::id()))
}

/// Decodes a recording, a robot recording or a picture: its frames up to a number that keeps a
/// single input short, and the description of its contents.
pub fn decode(name: &str, bytes: &[u8]) {
    let options = SourceOptions { max_frames: Some(4), color: true, ..SourceOptions::default() };
    decode_with(name, bytes, &options);
}

/// Decodes a recording with options.
pub fn decode_with(name: &str, bytes: &[u8], options: &SourceOptions) {
    judge_panics();
    let path = scratch(name);
    std::fs::write(&path, bytes).expect("the file in memory can be written");
    if let Ok(mut source) = open(&path, options) {
        while let Ok(Some(frame)) = source.next_frame() {
            std::hint::black_box(frame.rgb());
        }
        source.take_warnings();
    }
}

/// The other readers of a robot recording: its contents, camera, mount, sensors and positions.
pub fn read_topics(name: &str, bytes: &[u8]) {
    judge_panics();
    let path = scratch(name);
    std::fs::write(&path, bytes).expect("the file in memory can be written");
    let _ = odograph_video::inspect(&path);
    let _ = odograph_video::recorded_camera(&path, None);
    let _ = odograph_video::recorded_mount(&path, None);
    let sensors = [("/imu", SensorKind::Gyro), ("/odom", SensorKind::Wheel), ("/range", SensorKind::Range)];
    for (topic, kind) in sensors {
        let _ = odograph_video::recorded_sensor(&path, topic, kind);
    }
    let _ = odograph_video::recorded_fixes(&path, "/fix");
}

/// A small map with a mosaic and a path, as a file's bytes.
pub fn small_map() -> Vec<u8> {
    let path = scratch("base.gpkg");
    let _ = std::fs::remove_file(&path);
    let make = || -> odograph::error::Result<()> {
        let camera = Camera::new((64, 48), (52.0, 52.0), (31.5, 23.5), Distortion::None)?;
        let mut map = MapFile::create(&path, &camera, &Rig::level(0.5))?;
        let session = map.begin_session("drive.mp4")?;
        let samples = (0..64 * 48).map(|at: u32| (at.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        let image = KeyframeImage { gray: GrayImage::from_samples(64, 48, samples).unwrap_or_else(|| GrayImage::new(64, 48)), color: None };
        let pose = |number: u64| GroundPose { x_m: 0.1 * number as f64, ..GroundPose::level(0.5) };
        let covariance = Matrix6::from_diagonal_element(1e-6);
        for number in 0..4 {
            let feature = |k: u64| GroundFeature {
                descriptor: [number, k, k << 20, !k],
                position_m: [0.01 * k as f32, 0.0],
                direction_rad: 0.0,
            };
            let keyframe = MapKeyframe {
                id: KeyframeId(number),
                session,
                segment: 0,
                frame: 10 * number,
                time_s: 0.3 * number as f64,
                pose: pose(number),
                odometry_pose: pose(number),
                covariance,
                signature: Signature { features: (0..4).map(feature).collect() },
            };
            let edge = |number| MapEdge {
                from: KeyframeId(number - 1),
                to: KeyframeId(number),
                kind: EdgeKind::Odometry,
                motion: Vector4::new(0.1, 0.0, 0.0, 0.0),
                covariance: Matrix4::from_diagonal_element(1e-8),
            };
            let edges: Vec<MapEdge> = (number > 0).then(|| edge(number)).into_iter().collect();
            map.add_keyframe(&keyframe, &image, &edges)?;
        }
        let frame = |frame| PathFrame { frame, segment: 0, time_s: frame as f64, pose: pose(frame) };
        map.set_path(session, &(0..8).map(frame).collect::<Vec<_>>())?;
        map.render_mosaic(None, &mut |_| true)?;
        map.close()
    };
    make().expect("a small map can be made");
    std::fs::read(&path).expect("the map can be read")
}

/// The map with changed bytes: each six bytes of the input replace a byte (or, with an odd first
/// byte, a run of them by their sum) at a place of the file.
pub fn changed_map(map: &[u8], changes: &[u8]) -> Vec<u8> {
    let mut bytes = map.to_vec();
    for change in changes.chunks_exact(6) {
        let at = u32::from_le_bytes([change[1], change[2], change[3], 0]) as usize % bytes.len();
        let count = if change[0] & 1 == 1 { 1 + usize::from(change[5] % 9) } else { 1 };
        let end = (at + count).min(bytes.len());
        bytes[at..end].fill(change[4]);
    }
    bytes
}

/// Reads a map as the program's commands do, thins it, and repairs it.
pub fn use_map(bytes: &[u8]) {
    judge_panics();
    let (path, repaired) = (scratch("map.gpkg"), scratch("repaired.gpkg"));
    let write = || std::fs::write(&path, bytes).expect("the file in memory can be written");
    write();
    if let Ok(mut map) = MapFile::open_read_only(&path) {
        let _ = (map.check(), map.sessions(), map.path_of(0), map.image_bytes());
        if let Ok(Some(layer)) = map.mosaic() {
            let _ = map.mosaic_picture(1 << 20);
            let mut picture = std::io::Cursor::new(Vec::new());
            let _ = map.write_geotiff(&layer, &mut picture, None, &mut || Ok(()));
        }
    }
    if let Ok(mut map) = MapFile::open(&path) {
        let _ = (map.thin(2), map.begin_session("again"), map.next_keyframe(), map.close());
    }
    write();
    let _ = odograph_map::repair(&path, &repaired, &mut || true);
    let _ = MapFile::remove(&path);
    let _ = MapFile::remove(&repaired);
}
