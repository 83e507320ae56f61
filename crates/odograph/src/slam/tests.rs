use super::*;
use crate::camera::{Camera, Rig};
use crate::geometry::GroundPose;
use crate::ground_map::{GroundMap, KeyframeImages, MemoryImages, MountedCamera};
use crate::image::GrayImage;
use crate::keyframe::relative_pose::{compose, relative_motion};
use crate::keyframe::{EdgeKind, KeyframeId, MapEdge};
use crate::loop_closure::LoopClosureConfig;
use crate::motion::Random;
use crate::odometry::{FrameReference, KeyframeEvent, NewKeyframe, Odometry, OdometryConfig};
use crate::simulation::{Ground, Renderer, shared_ground};
use crate::trajectory::{FrameEstimate, PlaneMeasurement, TrackStatus};
use nalgebra::{Matrix4, Matrix6, Vector4};

const HEIGHT_M: f64 = 0.75;
const FRAME_S: f64 = 1.0 / 15.0;

/// A camera that sees 0.96 m across and 0.72 m along, and the ground below it.
struct SlamWorld {
    camera: Camera,
    ground: Box<dyn Fn(&GroundPose) -> GrayImage>,
    noise: u32,
}

fn camera() -> Camera {
    Camera::new((320, 240), (250.0, 250.0), (160.0, 119.5), crate::camera::Distortion::None).unwrap()
}

impl SlamWorld {
    fn new(texture: &str) -> Self {
        let camera = camera();
        let renderer = Renderer::new(&camera);
        let ground = shared_ground(texture, renderer.footprint_m(HEIGHT_M), 3);
        Self { camera, ground: Box::new(move |pose| renderer.gray_view(&ground, pose)), noise: 3 }
    }

    /// A floor of one repeated tile.
    fn repeating(tile_m: f64) -> Self {
        const CELLS: usize = 24;
        let mut random = Random::new(11);
        let tile: Vec<f64> = (0..CELLS * CELLS).map(|_| 40.0 + random.below(170) as f64).collect();
        let at = move |x_m: f64, y_m: f64| {
            let cell = |value: f64| (value / tile_m).rem_euclid(1.0) * CELLS as f64;
            let (x, y) = (cell(x_m), cell(y_m));
            let (i, j) = (x as usize, y as usize);
            let (a, b) = (x - i as f64, y - j as f64);
            let sample = |i: usize, j: usize| tile[(j % CELLS) * CELLS + i % CELLS];
            (1.0 - b) * ((1.0 - a) * sample(i, j) + a * sample(i + 1, j))
                + b * ((1.0 - a) * sample(i, j + 1) + a * sample(i + 1, j + 1))
        };
        let view = move |pose: &GroundPose| {
            let camera = camera();
            let mut image = GrayImage::new(320, 240);
            for (index, sample) in image.samples_mut().iter_mut().enumerate() {
                let pixel = crate::geometry::Pixel::new((index % 320) as f64, (index / 320) as f64);
                let place = camera.ray_from_pixel(pixel).and_then(|ray| pose.ground_from_ray(ray)).unwrap();
                *sample = at(place.x_m, place.y_m) as u8;
            }
            image
        };
        Self { camera: camera(), ground: Box::new(view), noise: 3 }
    }

    fn image(&self, pose: Option<GroundPose>, number: u64) -> GrayImage {
        let Some(pose) = pose else { return GrayImage::new(320, 240) };
        let mut image = (self.ground)(&pose);
        let mut random = Random::new(number);
        for sample in image.samples_mut() {
            let noise: i32 =
                (0..4).map(|_| random.below(self.noise as usize) as i32 - self.noise as i32 / 2).sum();
            *sample = (i32::from(*sample) + noise).clamp(0, 255) as u8;
        }
        image
    }

    /// Drives over the poses; `None` is darkness. Odometry remembers no keyframes, so what is seen
    /// again is for the map to find.
    fn drive(&self, mapper: &mut Mapper, images: &mut MemoryImages, poses: &[Option<GroundPose>]) -> Driven {
        self.drive_with(mapper, images, poses, |_| ())
    }

    /// Drives over the poses with keyframes that are changed before they reach the map.
    fn drive_with(
        &self,
        mapper: &mut Mapper,
        images: &mut MemoryImages,
        poses: &[Option<GroundPose>],
        change: impl Fn(&mut NewKeyframe),
    ) -> Driven {
        let mut odometry = Odometry::new(self.camera.clone(), Rig::level(HEIGHT_M), config()).unwrap();
        odometry.record_keyframes();
        let (mut frames, mut references) = (Vec::new(), Vec::new());
        for (number, pose) in poses.iter().enumerate() {
            let image = self.image(*pose, number as u64);
            frames.push(odometry.process(image, number as f64 * FRAME_S).unwrap());
            references.push(odometry.reference());
            for mut event in odometry.take_keyframe_events() {
                if let KeyframeEvent::Made(keyframe) = &mut event {
                    change(keyframe);
                }
                mapper.take(event, None, images).unwrap();
            }
        }
        mapper.finish();
        let straight = map_frames(mapper, &frames, &references);
        Driven { frames, references, straight }
    }

    fn mapper(&self) -> Mapper {
        Mapper::new(&self.camera, Rig::level(HEIGHT_M), &config(), LoopClosureConfig::default())
    }
}

fn config() -> OdometryConfig {
    let mut config = OdometryConfig::default();
    config.keyframe.remembered = 0;
    config
}

struct Driven {
    frames: Vec<FrameEstimate>,
    references: Vec<Option<FrameReference>>,
    straight: Vec<FrameEstimate>,
}

fn at(x_m: f64, y_m: f64, heading_rad: f64) -> Option<GroundPose> {
    Some(GroundPose { x_m, y_m, heading_rad, ..GroundPose::level(HEIGHT_M) })
}

/// Straight on in steps of 4 cm.
fn along(from: (f64, f64), heading_rad: f64, count: usize) -> impl Iterator<Item = Option<GroundPose>> {
    let (sin, cos) = heading_rad.sin_cos();
    (0..count).map(move |i| at(from.0 + 0.04 * i as f64 * cos, from.1 + 0.04 * i as f64 * sin, heading_rad))
}

/// Largest position error from a frame on, millimetres; infinite without frames.
fn worst_mm(frames: &[FrameEstimate], truth: &[Option<GroundPose>]) -> f64 {
    let off = frames.iter().zip(truth).filter_map(|(frame, truth)| {
        let (found, truth) = (frame.estimate.as_ref()?.pose, truth.as_ref()?);
        Some(1e3 * (found.x_m - truth.x_m).hypot(found.y_m - truth.y_m))
    });
    off.reduce(f64::max).unwrap_or(f64::INFINITY)
}

#[test]
fn without_loops_nothing_is_changed() {
    let world = SlamWorld::new("asphalt");
    let poses: Vec<_> = along((0.0, 0.0), 0.0, 40).collect();
    let mut mapper = world.mapper();
    let driven = world.drive(&mut mapper, &mut MemoryImages::default(), &poses);
    assert!(mapper.map().keyframes.len() > 3 && mapper.closures().is_empty());
    assert_eq!(driven.frames, driven.straight);
}

#[test]
fn ground_seen_again_after_darkness_ties_the_path_together() {
    let world = SlamWorld::new("asphalt");
    let mut poses: Vec<_> = along((0.0, 0.0), 0.0, 60).collect();
    poses.extend([None; 20]);
    // Meanwhile the camera was turned and moved to another place of its path.
    let dark = poses.len();
    poses.extend(along((1.2, 0.1), 2.9, 30));
    let mut mapper = world.mapper();
    let driven = world.drive(&mut mapper, &mut MemoryImages::default(), &poses);
    let last = &driven.frames[driven.frames.len() - 1];
    assert_eq!((last.status, last.segment), (TrackStatus::Tracked, 1));
    let (before, after) = (
        worst_mm(&driven.frames[dark..], &poses[dark..]),
        worst_mm(&driven.straight[dark..], &poses[dark..]),
    );
    assert!(!mapper.closures().is_empty());
    // A pixel is 3 mm; half a millimetre is what the worst frame of a picture of 320x240 may be off
    // beside the loops' tenth of a pixel.
    assert!(
        before > 300.0 && after < 0.5,
        "{before} mm in the dark's wake, {after} mm after it is recognised"
    );
}

#[test]
fn whole_turns_add_up_over_a_gap_that_a_loop_closes() {
    let world = SlamWorld::new("asphalt");
    let mut poses: Vec<_> = along((0.0, 0.0), 0.0, 60).collect();
    poses.extend((1..30).map(|i| at(2.4, 0.0, 0.1 * i as f64)));
    poses.extend([None; 20]);
    poses.extend(along((1.2, 0.1), 3.3, 30));
    let (mut mapper, mut images) = (world.mapper(), MemoryImages::default());
    let driven = world.drive(&mut mapper, &mut images, &poses);
    assert!(!mapper.closures().is_empty());
    for (frame, truth) in driven.straight.iter().zip(&poses) {
        let Some(known) = &frame.estimate else { continue };
        let off_rad = known.pose.heading_rad - truth.unwrap().heading_rad;
        assert!(off_rad.abs() < 0.02, "{:.3} s: {off_rad}", frame.time_s);
        assert!((known.measured.heading_rad - known.pose.heading_rad).abs() < 0.5);
    }
}

#[test]
fn a_floor_of_equal_tiles_does_not_fool_it() {
    let world = SlamWorld::repeating(0.31);
    let mut poses: Vec<_> = along((0.0, 0.0), 0.0, 50).collect();
    poses.extend([None; 20]);
    poses.extend(along((1.17, 0.13), 0.4, 45));
    let mut mapper = world.mapper();
    let driven = world.drive(&mut mapper, &mut MemoryImages::default(), &poses);
    assert!(driven.frames.iter().any(|frame| frame.segment == 1), "the ground is followed again");
    assert!(mapper.closures().is_empty(), "{:?}", mapper.closures());
}

/// Out, a turn on the spot, and back, with an error of odometry in the turn that no covariance
/// states. The number of loops that correct it.
fn corrected(unstated_m: f64) -> usize {
    let world = SlamWorld::new("asphalt");
    let mut poses: Vec<_> = along((0.0, 0.0), 0.0, 60).collect();
    let turning = poses.len() as u64;
    poses.extend((1..=31).map(|i| at(2.36, 0.0, 0.1 * f64::from(i))));
    poses.extend(along((2.32, 0.0), 3.1, 56));
    let mut mapper = world.mapper();
    let is_displaced = std::cell::Cell::new(false);
    world.drive_with(&mut mapper, &mut MemoryImages::default(), &poses, |keyframe| {
        if keyframe.frame > turning && !is_displaced.replace(true) {
            keyframe.tie.iter_mut().for_each(|tie| tie.motion[0] += unstated_m);
        }
    });
    mapper.closures().iter().filter(|closure| closure.correction_m > 0.5 * unstated_m).count()
}

/// Odometry that states its error too small contradicts every loop. A second sighting confirms the
/// first, but not far off: patterns repeat.
#[test]
fn loops_are_closed_beyond_what_odometry_states_but_not_far_beyond() {
    let (beyond, far_beyond) = (corrected(0.004), corrected(0.1));
    assert!(beyond >= 2 && far_beyond == 0, "{beyond} {far_beyond}");
}

#[test]
fn a_second_drive_is_recognised_in_the_first_map() {
    let world = SlamWorld::new("carpet");
    let mut images = MemoryImages::default();
    let mut first = world.mapper();
    world.drive(&mut first, &mut images, &along((0.0, 0.0), 0.0, 60).collect::<Vec<_>>());
    let map: GroundMap = first.into_map();
    let next = KeyframeId(map.keyframes.len() as u64);
    let mut second = Mapper::continuing(map.clone(), &config(), LoopClosureConfig::default(), 1, next);
    let poses: Vec<_> = along((2.1, 0.15), -2.5, 40).collect();
    let driven = world.drive(&mut second, &mut images, &poses);
    assert!(second.is_recognised());
    // A sixth of a pixel, at the worst frame of a drive with few loop closures at 320x240.
    let off_mm = worst_mm(&driven.straight, &poses);
    assert!(off_mm < 0.5, "{off_mm} mm");
    // A loop closure does not move a correct map by more than its own error.
    let still = second.map().keyframes.iter().zip(&map.keyframes).take(map.keyframes.len());
    for (now, before) in still {
        let moved_m = (now.pose.x_m - before.pose.x_m).hypot(now.pose.y_m - before.pose.y_m);
        assert!(moved_m < 1e-4, "keyframe {:?} moved by {moved_m} m", now.id);
    }

    // The same as two maps that are joined.
    let mut alone = world.mapper();
    let mut alone_images = MemoryImages::default();
    world.drive(&mut alone, &mut alone_images, &poses);
    let other = alone.into_map();
    let mut joined = Mapper::continuing(map.clone(), &config(), LoopClosureConfig::default(), 1, next);
    let merged = merge(&mut joined, &mut images, &other, &mut alone_images, &[]).unwrap();
    assert_eq!(merged.keyframes, other.keyframes.len());
    assert!(merged.loops >= 2, "{merged:?}");
    let place = joined.map().keyframes.last().unwrap();
    let truth = poses[place.frame as usize].unwrap();
    let off_mm = 1e3 * (place.pose.x_m - truth.x_m).hypot(place.pose.y_m - truth.y_m);
    assert!(off_mm < 0.5, "{off_mm} mm");
    assert!(images.load(KeyframeId(0)).is_ok());
}

/// A wheel that turns 2 % further than the odometry says.
#[test]
fn fused_sensors_move_the_session_that_is_driven_and_no_earlier_one() {
    let world = SlamWorld::new("carpet");
    let mut images = MemoryImages::default();
    let mut first = world.mapper();
    world.drive(&mut first, &mut images, &along((0.0, 0.0), 0.0, 40).collect::<Vec<_>>());
    let map = first.into_map();
    let next = KeyframeId(map.keyframes.len() as u64);
    let mut second = Mapper::continuing(map.clone(), &config(), LoopClosureConfig::default(), 1, next);
    let poses: Vec<_> = along((20.0, 5.0), 1.0, 30).collect();
    let mut driven = world.drive(&mut second, &mut images, &poses);
    let before = second.map().clone();
    let longer = |frame: &FrameEstimate| {
        let mut frame = frame.clone();
        if let Some(estimate) = &mut frame.estimate {
            let pose = estimate.pose;
            let (x_m, y_m, height_m) = (1.02 * pose.x_m, 1.02 * pose.y_m, 1.02 * pose.height_m);
            estimate.pose = GroundPose { x_m, y_m, height_m, ..pose };
            estimate.measured = PlaneMeasurement::new(&estimate.pose, &estimate.covariance);
        }
        frame
    };
    let fused: Vec<FrameEstimate> = driven.frames.iter().map(longer).collect();
    second.apply_fusion(&driven.frames, &fused, &mut driven.references);
    let (old, new) = second.map().keyframes.split_at(map.keyframes.len());
    for (now, was) in old.iter().zip(&map.keyframes) {
        assert_eq!((now.pose, now.odometry_pose), (was.pose, was.odometry_pose), "{:?}", now.id);
    }
    let edges = second.map().edges.iter().zip(&map.edges);
    edges.for_each(|(now, was)| assert_eq!(now.motion, was.motion));
    for (now, was) in new.iter().zip(&before.keyframes[map.keyframes.len()..]) {
        let off_m = (now.pose.x_m - 1.02 * was.pose.x_m).hypot(now.pose.y_m - 1.02 * was.pose.y_m);
        // A keyframe moves as the frame that is measured against it first, which is filtered.
        assert!(off_m < 1e-6, "{off_m} m");
    }
}

#[test]
fn a_map_elsewhere_is_not_recognised() {
    let world = SlamWorld::new("asphalt");
    let mut images = MemoryImages::default();
    let mut first = world.mapper();
    world.drive(&mut first, &mut images, &along((0.0, 0.0), 0.0, 40).collect::<Vec<_>>());
    let map = first.into_map();
    let next = KeyframeId(map.keyframes.len() as u64);
    let mut second = Mapper::continuing(map, &config(), LoopClosureConfig::default(), 1, next);
    world.drive(&mut second, &mut images, &along((20.0, 5.0), 1.0, 30).collect::<Vec<_>>());
    assert!(!second.is_recognised() && second.closures().is_empty());
}

/// Two keyframes with any number of sightings of each other.
fn revisited(mapper: &mut Mapper, images: &mut MemoryImages, times: usize) -> usize {
    let revisit = MapEdge {
        from: KeyframeId(1),
        to: KeyframeId(0),
        kind: EdgeKind::Loop,
        motion: Vector4::new(-0.2, 0.0, 0.0, 0.0),
        covariance: Matrix4::from_diagonal(&Vector4::new(1e-8, 1e-8, 1e-8, 0.0)),
    };
    for _ in 0..times {
        mapper.take(KeyframeEvent::Revisited(revisit), None, images).unwrap();
    }
    mapper.map().edges.iter().filter(|edge| edge.kind == EdgeKind::Loop).count()
}

#[test]
fn repeated_laps_do_not_grow_the_graph() {
    let world = SlamWorld::new("asphalt");
    let mut mapper =
        Mapper::new(&world.camera, Rig::level(HEIGHT_M), &config(), LoopClosureConfig::default());
    let mut images = MemoryImages::default();
    world.drive(&mut mapper, &mut images, &along((0.0, 0.0), 0.0, 14).collect::<Vec<_>>());
    assert!(mapper.map().keyframes.len() >= 2);
    mapper.suspend_loop_search(true);
    assert_eq!(revisited(&mut mapper, &mut images, 3), 0);
    mapper.suspend_loop_search(false);
    let few = revisited(&mut mapper, &mut images, 3);
    assert_eq!(few, 3);
    assert_eq!(revisited(&mut mapper, &mut images, 5), revisited(&mut mapper, &mut images, 50));
}

/// Keyframes in four lanes, with edges that rotate and scale every step: the effect of low texture
/// and an uncalibrated mount on a long drive.
fn bent_lanes() -> (Vec<GroundPose>, Vec<MapEdge>) {
    let place = |i: usize| {
        let (lane, along) = (i / 8, i % 8);
        let x = 0.3 * if lane % 2 == 0 { along } else { 7 - along } as f64;
        GroundPose { x_m: x, y_m: 0.35 * lane as f64, ..GroundPose::level(HEIGHT_M) }
    };
    let truth: Vec<GroundPose> = (0..32).map(place).collect();
    let tie = |i: usize| {
        let mut motion = relative_motion(&truth[i - 1], &truth[i]) * 1.001;
        motion[2] += 0.003;
        let sigmas = Vector4::new(1e-3, 1e-3, 3e-3, 0.0);
        let covariance = Matrix4::from_diagonal(&sigmas.component_mul(&sigmas));
        let [from, to] = [i - 1, i].map(|i| KeyframeId(i as u64));
        MapEdge { from, to, kind: EdgeKind::Odometry, motion, covariance }
    };
    let ties = (1..truth.len()).map(tie).collect();
    (truth, ties)
}

#[test]
fn bent_lanes_that_see_each_other_come_out_straight() {
    let world = SlamWorld::new("concrete");
    let (truth, ties) = bent_lanes();
    let (mut mapper, mut images) = (world.mapper(), MemoryImages::default());
    let (mut pose, mut bent_m) = (truth[0], 0.0f64);
    let off_m = |a: &GroundPose, b: &GroundPose| (a.x_m - b.x_m).hypot(a.y_m - b.y_m);
    for (i, place) in truth.iter().enumerate() {
        let tie = i.checked_sub(1).map(|before| ties[before]);
        if let Some(tie) = &tie {
            pose = compose(&pose, &tie.motion, 1.0);
        }
        bent_m = bent_m.max(off_m(&pose, place));
        let new = NewKeyframe {
            id: KeyframeId(i as u64),
            frame: i as u64,
            time_s: i as f64,
            segment: 0,
            pose,
            covariance: Matrix6::zeros(),
            systematic: Matrix6::zeros(),
            tie,
            image: world.image(Some(*place), i as u64),
            mask: None,
            ground: None,
        };
        mapper.take(KeyframeEvent::Made(Box::new(new)), None, &mut images).unwrap();
    }
    mapper.finish();
    let map = mapper.map();
    let straight_m =
        map.keyframes.iter().zip(&truth).map(|(k, truth)| off_m(&k.pose, truth)).fold(0.0, f64::max);
    assert!(straight_m < 0.2 * bent_m, "{bent_m} m without loops, {straight_m} m with");
    // No loop is false: each is right to a fifth of a pixel of 3 mm.
    assert!(mapper.closures().len() > 5, "{} loops", mapper.closures().len());
    for closure in mapper.closures() {
        let [from, to] = [closure.edge.from, closure.edge.to].map(|id| &truth[id.0 as usize]);
        let off = relative_motion(from, to) - closure.edge.motion;
        assert!(off[0].hypot(off[1]) < 6e-4, "{closure:?} is off by {off}");
    }
}

#[test]
fn the_map_pose_follows_the_frame_as_it_comes() {
    let world = SlamWorld::new("asphalt");
    let mut images = MemoryImages::default();
    let mut odometry = Odometry::new(world.camera.clone(), Rig::level(HEIGHT_M), config()).unwrap();
    odometry.record_keyframes();
    let mut mapper = world.mapper();
    for (number, pose) in along((0.0, 0.0), 0.0, 12).enumerate() {
        let frame = odometry.process(world.image(pose, number as u64), number as f64 * FRAME_S).unwrap();
        for event in odometry.take_keyframe_events() {
            mapper.take(event, None, &mut images).unwrap();
        }
        let (pose, reference) = (frame.estimate.unwrap().pose, odometry.reference().unwrap());
        let keyframe = mapper.of_run(reference.keyframe).unwrap();
        assert_eq!(keyframe.map_from_odometry().apply_to_pose(&pose), pose);
    }
    mapper.finish();
    assert!(!mapper.map().keyframes.is_empty());
}

/// A robot with a camera of its own over the ground of all.
struct FleetRobot {
    mounted: MountedCamera,
    /// Height of its camera, metres; the rig has what it was told.
    height_m: f64,
}

impl FleetRobot {
    fn new(size: (usize, usize), focal_px: f64, height_m: f64, told_m: f64) -> Self {
        let principal = (0.5 * (size.0 as f64 - 1.0), 0.5 * (size.1 as f64 - 1.0));
        let lens = crate::camera::Distortion::None;
        let camera = Camera::new(size, (focal_px, focal_px), principal, lens).unwrap();
        Self { mounted: MountedCamera { camera, rig: Rig::level(told_m) }, height_m }
    }

    /// Drives over places and gives its keyframe events.
    fn drive(&self, ground: &Ground, places: &[(f64, f64, f64)]) -> Vec<KeyframeEvent> {
        let MountedCamera { camera, rig } = &self.mounted;
        let renderer = Renderer::new(camera);
        let mut odometry = Odometry::new(camera.clone(), *rig, config()).unwrap();
        odometry.record_keyframes();
        let mut events = Vec::new();
        for (number, &(x_m, y_m, heading_rad)) in places.iter().enumerate() {
            let pose = GroundPose { x_m, y_m, heading_rad, ..GroundPose::level(self.height_m) };
            odometry.process(renderer.gray_view(ground, &pose), number as f64 * FRAME_S).unwrap();
            events.extend(odometry.take_keyframe_events());
        }
        events
    }
}

/// Adds what a robot sent as a session, its keyframes numbered from `first`.
fn add_session(
    fleet: &mut FleetMapper,
    images: &mut MemoryImages,
    robot: &FleetRobot,
    events: Vec<KeyframeEvent>,
    session: u32,
    first: u64,
) {
    fleet.begin_session(session, &robot.mounted);
    for event in events {
        let KeyframeEvent::Made(new) = event else { continue };
        let number = |id: KeyframeId| KeyframeId(first + id.0);
        let edges: Vec<MapEdge> = new
            .tie
            .iter()
            .map(|tie| MapEdge { from: number(tie.from), to: number(tie.to), ..*tie })
            .collect();
        let new = NewKeyframe { id: number(new.id), tie: None, ..*new };
        fleet.add(new, session, &edges, None, images).unwrap();
    }
}

fn lane(from: (f64, f64), heading_rad: f64, count: usize) -> Vec<(f64, f64, f64)> {
    let (sin, cos) = heading_rad.sin_cos();
    (0..count)
        .map(|i| (from.0 + 0.04 * i as f64 * cos, from.1 + 0.04 * i as f64 * sin, heading_rad))
        .collect()
}

/// Two robots with different cameras and heights over the same ground; the second begins elsewhere.
fn fleet_of(second: &FleetRobot) -> FleetMapper {
    let first = FleetRobot::new((320, 240), 250.0, HEIGHT_M, HEIGHT_M);
    let footprint_m = Renderer::new(&first.mounted.camera).footprint_m(HEIGHT_M);
    let ground = shared_ground("asphalt", footprint_m, 3);
    let map = GroundMap {
        camera: first.mounted.camera.clone(),
        rig: first.mounted.rig,
        other_cameras: Default::default(),
        masks: Default::default(),
        keyframes: Vec::new(),
        edges: Vec::new(),
    };
    let (mut fleet, mut images) = (FleetMapper::new(map, &config()), MemoryImages::default());
    let events = first.drive(&ground, &lane((0.0, 0.0), 0.0, 100));
    add_session(&mut fleet, &mut images, &first, events, 0, 0);
    let events = second.drive(&ground, &lane((3.2, -0.15), 3.0, 70));
    add_session(&mut fleet, &mut images, second, events, 1, 1000);
    fleet.finish();
    fleet
}

#[test]
fn robots_with_different_cameras_and_heights_share_a_map() {
    let fleet = fleet_of(&FleetRobot::new((400, 300), 330.0, 0.9, 0.9));
    assert!(fleet.is_connected(1));
    let scale = fleet.scale(1).expect("they saw the same ground");
    assert!((scale.ratio - 1.0).abs() < 0.003, "{scale:?}");
    let last = fleet.map().keyframes.iter().rfind(|keyframe| keyframe.session == 1).unwrap();
    // At the last keyframe, wherever on its lane that is, the second robot is on its lane.
    let along_m = (last.pose.x_m - 3.2) / 3.0_f64.cos();
    let off_m = last.pose.y_m - (-0.15 + along_m * 3.0_f64.sin());
    assert!(along_m > 1.5 && off_m.abs() < 0.005, "{:?}", last.pose);
    let placement = fleet.placement(1).unwrap();
    assert_eq!(placement.keyframe, last.id);
    let sigma_m = placement.covariance[(1, 1)].sqrt();
    assert!((off_m.abs() / sigma_m) < 5.0 && sigma_m < 0.02, "{off_m} {sigma_m}");
    // Without the first robot nothing is left of its keyframes, and the second stays.
    let pose = last.pose;
    let left = fleet.without(&[0].into());
    assert!(left.map().keyframes.iter().all(|keyframe| keyframe.session == 1));
    assert_eq!(left.map().keyframes.last().unwrap().pose, pose);
    assert!(left.map().edges.iter().all(|edge| edge.from.0 >= 1000 && edge.to.0 >= 1000));
}

#[test]
fn a_height_that_is_wrong_shows_in_the_scale_of_recognised_places() {
    for told in [0.96, 1.02, 1.06] {
        let fleet = fleet_of(&FleetRobot::new((400, 300), 330.0, 0.9, 0.9 * told));
        let scale = fleet.scale(1).expect("they saw the same ground");
        assert!((scale.ratio * told - 1.0).abs() < 0.004 && scale.deviation < 0.005, "{told}: {scale:?}");
    }
}
