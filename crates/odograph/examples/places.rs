//! Place-recognition benchmark on rendered ground with exact ground truth.
//!
//! `cargo run --release -p odograph --example places -- recall | unknown | kidnapped | speed
//! [ground …] [seed=N] [area=N]`
//!
//! The grounds are the rendered textures, and `repeating`: a floor of one tile of 31 cm, repeated
//! without any distinguishing mark. The seed selects ground and images; parameters were tuned with
//! seed 0.
//!
//! * `recall`: pairs of images with 30 % overlap, any heading and tilts up to 10°; the second image
//!   is blurred and under other lighting. All first images of a ground form one map, which is
//!   queried with the second images.
//! * `unknown`: 484 images of ground that is in no map, queried against 49 maps of ten keyframes
//!   each of the same kind of ground, and against one map of all of these. A query is one image
//!   against one map: 24,200 per ground.
//! * `kidnapped`: single images anywhere in a map of 1,000 m² (or `area`), with any heading,
//!   blurred and under other lighting: recognised, and registered against the keyframe that shows
//!   their ground, each as a recording of one frame that continues the map. Height and tilt of the
//!   camera are known, as for a fixed mount.
//! * `speed`: queries of a map of 10,000 keyframes. It consists of 400 images and 24 copies of
//!   each, whose descriptors are XORed with a constant. This keeps the descriptor statistics but
//!   makes each copy a different place.

#![allow(clippy::print_stdout)] // prints a table

mod processor_time;

use nalgebra::Matrix6;
use odograph::camera::{Camera, Distortion, Rig};
use odograph::error::Result;
use odograph::geometry::{GroundPose, Pixel, PlaneTransform, Se2, wrap_angle};
use odograph::ground_map::{GroundMap, KeyframeImage, MapKeyframe};
use odograph::ground_map::{KeyframeStore, MemoryImages};
use odograph::image::{GrayImage, Pyramid, RgbImage};
use odograph::keyframe::{KeyframeId, MapEdge};
use odograph::loop_closure::LoopClosureConfig;
use odograph::motion::Random;
use odograph::odometry::{KeyframeEvent, NewKeyframe, OdometryConfig};
use odograph::place_recognition::{PlaceHypothesis, PlaceIndex, PlacesConfig, Signature};
use odograph::slam::Mapper;
use odograph_simulation::{Ground, Renderer, Texture, Tiling};
use processor_time::busy_ms;
use std::f64::consts::PI;

const HEIGHT_M: f64 = 0.75;
const NOISE_GRAY: f64 = 3.0;

const REPEATING: &str = "repeating";

/// A richly textured tile, repeated.
fn one_tile() -> Result<Texture> {
    const CELLS: usize = 48;
    let mut random = Random::new(5);
    let samples = (0..CELLS * CELLS).map(|_| 40 + random.below(170) as u8).collect();
    let tile = GrayImage::from_samples(CELLS, CELLS, samples).unwrap_or(GrayImage::new(CELLS, CELLS));
    Texture::from_image(&RgbImage::from(&tile), 0.31 / CELLS as f64, Tiling::Repeat)
}

/// A camera over a ground.
struct ExampleScene {
    camera: Camera,
    renderer: Renderer,
    ground: Ground,
    random: Random,
    config: PlacesConfig,
}

impl ExampleScene {
    /// An image width of `size_px`, with a field of view of 0.96 m by 0.72 m.
    fn new(name: &str, size_px: usize, seed: u64) -> Result<Self> {
        let size = (size_px, size_px * 3 / 4);
        let focal_px = size_px as f64 * 500.0 / 640.0;
        let lens = Distortion::from_opencv(&[-0.12, 0.03, 0.0005, -0.0003]).unwrap_or(Distortion::None);
        let centre = (0.502 * size.0 as f64, 0.497 * size.1 as f64);
        let camera = Camera::new(size, (focal_px, focal_px), centre, lens)?;
        let renderer = Renderer::new(&camera);
        let texture = match name {
            REPEATING => one_tile()?,
            name => Texture::named(name).unwrap_or(Texture::Asphalt),
        };
        let ground = Ground::new(texture, renderer.footprint_m(HEIGHT_M), false, 7 + seed)?;
        let config = PlacesConfig::new(&camera, HEIGHT_M);
        Ok(Self { camera, renderer, ground, random: Random::new(11 + seed), config })
    }

    /// A uniform random number in [-1, 1).
    fn signed(&mut self) -> f64 {
        self.random.below(1 << 30) as f64 / f64::from(1 << 29) - 1.0
    }

    fn pose(&mut self, x_m: f64, y_m: f64, tilt_rad: f64) -> GroundPose {
        let (heading_rad, roll, pitch) = (PI * self.signed(), self.signed(), self.signed());
        let (roll_rad, pitch_rad) = (tilt_rad * roll, tilt_rad * pitch);
        GroundPose { x_m, y_m, heading_rad, roll_rad, pitch_rad, ..GroundPose::level(HEIGHT_M) }
    }

    /// The camera image with noise; if `otherwise_lit`, blurred and under other lighting.
    fn picture(&mut self, pose: &GroundPose, otherwise_lit: bool) -> GrayImage {
        let mut image = self.renderer.gray_view(&self.ground, pose);
        let (mut gain, mut offset, mut slope) = (1.0, 0.0, (0.0, 0.0));
        if otherwise_lit {
            blur(&mut image);
            blur(&mut image);
            (gain, offset) = (1.0 + 0.25 * self.signed(), 15.0 * self.signed());
            slope = (0.3 * self.signed(), 0.3 * self.signed());
        }
        let (width, height) = (image.width(), image.height());
        for (i, sample) in image.samples_mut().iter_mut().enumerate() {
            let (x, y) = ((i % width) as f64 / width as f64 - 0.5, (i / width) as f64 / height as f64 - 0.5);
            // The sum of four uniform numbers of unit width has a standard deviation of 0.577.
            let noise: f64 = (0..4).map(|_| self.random.below(1 << 16) as f64 / 65536.0 - 0.5).sum();
            let light = gain * (1.0 + slope.0 * x + slope.1 * y);
            let gray = f64::from(*sample) * light + offset + NOISE_GRAY * noise / 0.577;
            *sample = gray.round().clamp(0.0, 255.0) as u8;
        }
        image
    }

    /// The place signature of the camera image, and its computation time, milliseconds.
    fn signature(&mut self, pose: &GroundPose, otherwise_lit: bool) -> (Signature, f64) {
        let pyramid = Pyramid::new(self.picture(pose, otherwise_lit), 4);
        let begun = busy_ms();
        let signature = Signature::of(&pyramid, &self.camera, None, pose, &self.config);
        (signature, busy_ms() - begun)
    }

    /// Overlap: the fraction of the ground in view from `of` that is also in view from `with`.
    fn overlap(&self, of: &GroundPose, with: &GroundPose) -> f64 {
        let (columns, rows) = (32, 24);
        let step = self.camera.width() as f64 / columns as f64;
        let ground = |i: usize| {
            let pixel = Pixel::new(((i % columns) as f64 + 0.5) * step, ((i / columns) as f64 + 0.5) * step);
            self.camera.ray_from_pixel(pixel).and_then(|ray| of.ground_from_ray(ray))
        };
        let shown = |point| with.ray_from_ground(point).and_then(|ray| self.camera.pixel_from_ray(ray));
        let points: Vec<_> = (0..columns * rows).filter_map(ground).collect();
        let inside = |pixel: &Pixel| self.camera.contains(*pixel, 0.0);
        points.iter().filter(|&&point| shown(point).is_some_and(|pixel| inside(&pixel))).count() as f64
            / points.len() as f64
    }
}

/// A 3×3 box filter; border pixels are unchanged.
fn blur(image: &mut GrayImage) {
    let (source, width) = (image.clone(), image.width());
    for y in 1..image.height() - 1 {
        for x in 1..width - 1 {
            let sum: u32 = (0..9).map(|i| u32::from(source.row(y + i / 3 - 1)[x + i % 3 - 1])).sum();
            image.samples_mut()[y * width + x] = ((sum + 4) / 9) as u8;
        }
    }
}

/// Error of a hypothesis: position in metres and heading in radians.
fn error(hypothesis: &PlaceHypothesis, keyframe: &GroundPose, query: &GroundPose) -> (f64, f64) {
    let (sin, cos) = keyframe.heading_rad.sin_cos();
    let (x, y) = (query.x_m - keyframe.x_m, query.y_m - keyframe.y_m);
    let off_m = (hypothesis.motion[0] - cos * x - sin * y).hypot(hypothesis.motion[1] + sin * x - cos * y);
    (off_m, wrap_angle(hypothesis.motion[2] - query.heading_rad + keyframe.heading_rad).abs())
}

/// Results of queries whose places are in the map.
#[derive(Default)]
struct Score {
    queries: usize,
    right: usize,
    sure: usize,
    sure_and_wrong: usize,
    off_mm: Vec<f64>,
    off_deg: Vec<f64>,
    signature_ms: Vec<f64>,
    query_ms: Vec<f64>,
}

impl Score {
    fn count(
        &mut self,
        scene: &ExampleScene,
        index: &PlaceIndex,
        keyframes: &[GroundPose],
        pose: &GroundPose,
        signature: &Signature,
    ) {
        let begun = busy_ms();
        let found = index.query(signature, 3);
        self.query_ms.push(busy_ms() - begun);
        self.queries += 1;
        let Some(best) = found.first() else { return };
        let (off_m, off_rad) = error(best, &keyframes[best.keyframe.0 as usize], pose);
        // Within five spots and 2° any registration converges.
        let right = off_m < 5.0 * scene.config.spot_m && off_rad < 2f64.to_radians();
        self.right += usize::from(right);
        self.sure += usize::from(right && best.is_sure());
        self.sure_and_wrong += usize::from(!right && best.is_sure());
        if right {
            self.off_mm.push(1e3 * off_m);
            self.off_deg.push(off_rad.to_degrees());
        }
    }

    fn print(mut self, name: &str) {
        let percent = |count: usize| 100.0 * count as f64 / self.queries as f64;
        println!(
            "{name:9} queries {:5}  first right {:6.2} %  right and sure {:6.2} %  wrong and sure {}  off {:.2} mm {:.3}° (median)  {:.2} mm {:.3}° (95 %)  \
             signature {:.2} ms  query {:.2} ms, at most {:.2} ms",
            self.queries,
            percent(self.right),
            percent(self.sure),
            self.sure_and_wrong,
            quantile(&mut self.off_mm, 0.5),
            quantile(&mut self.off_deg, 0.5),
            quantile(&mut self.off_mm, 0.95),
            quantile(&mut self.off_deg, 0.95),
            quantile(&mut self.signature_ms, 0.5),
            quantile(&mut self.query_ms, 0.5),
            quantile(&mut self.query_ms, 1.0),
        );
    }
}

fn quantile(values: &mut [f64], share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get((share * values.len().saturating_sub(1) as f64) as usize).copied().unwrap_or(f64::NAN)
}

fn recall(name: &str, seed: u64) -> Result<()> {
    let mut scene = ExampleScene::new(name, 640, seed)?;
    let mut index = PlaceIndex::new(&scene.config);
    let (mut keyframes, mut queries) = (Vec::new(), Vec::new());
    for number in 0..60 {
        let keyframe = scene.pose(3.0 * f64::from(number), 0.0, 10f64.to_radians());
        let (away, towards) = (scene.pose(0.0, 0.0, 10f64.to_radians()), PI * scene.signed());
        let mut query = away;
        let mut distance_m = 0.0;
        // Move the query away until the overlap is at most 30 % in one direction.
        loop {
            query.x_m = keyframe.x_m + distance_m * towards.cos();
            query.y_m = keyframe.y_m + distance_m * towards.sin();
            if scene.overlap(&query, &keyframe).min(scene.overlap(&keyframe, &query)) <= 0.3 {
                break;
            }
            distance_m += 0.01;
        }
        index.insert(KeyframeId(number as u64), &scene.signature(&keyframe, false).0);
        queries.push((query, scene.signature(&query, true)));
        keyframes.push(keyframe);
    }
    let mut score = Score::default();
    for (query, (signature, ms)) in &queries {
        score.signature_ms.push(*ms);
        score.count(&scene, &index, &keyframes, query, signature);
    }
    score.print(name);
    Ok(())
}

/// Keyframes on a grid with a spacing of `step_m`.
fn field(scene: &mut ExampleScene, side_m: f64, step_m: f64) -> Vec<GroundPose> {
    let steps = (side_m / step_m).ceil() as usize;
    (0..steps * steps)
        .map(|i| scene.pose((i % steps) as f64 * step_m, (i / steps) as f64 * step_m, 0.02))
        .collect()
}

fn kidnapped(name: &str, seed: u64, area_m2: f64) -> Result<()> {
    let mut scene = ExampleScene::new(name, 320, seed)?;
    let side_m = area_m2.sqrt();
    // The true poses of the map's keyframes, and of the queries that have joined it.
    let mut truth = field(&mut scene, side_m, 0.5);
    let mut images = MemoryImages::default();
    let mut map = GroundMap {
        camera: scene.camera.clone(),
        rig: Rig::level(HEIGHT_M),
        other_cameras: Default::default(),
        masks: Default::default(),
        keyframes: Vec::new(),
        edges: Vec::new(),
    };
    for (number, pose) in truth.iter().enumerate() {
        let gray = scene.picture(pose, false);
        let signature =
            Signature::of(&Pyramid::new(gray.clone(), 4), &scene.camera, None, pose, &scene.config);
        let keyframe = MapKeyframe {
            id: KeyframeId(number as u64),
            session: 0,
            segment: 0,
            frame: number as u64,
            time_s: number as f64,
            odometry_pose: *pose,
            pose: *pose,
            covariance: Matrix6::zeros(),
            signature,
        };
        images.keep(&keyframe, KeyframeImage { gray, color: None }, &[])?;
        map.keyframes.push(keyframe);
    }
    let in_map = truth.len();
    let new = KeyframeId(in_map as u64);
    let config = LoopClosureConfig { sightings: 1, ..LoopClosureConfig::default() };
    let mut mapper = Mapper::continuing(map, &OdometryConfig::default(), config, 1, new);
    let (mut off_mm, mut off_deg, mut times_ms, mut wrong) = (Vec::new(), Vec::new(), Vec::new(), 0);
    // A small area gets fewer queries, two per square metre.
    let queries = QUERIES.min((2.0 * area_m2) as usize);
    for number in 0..queries {
        let (x, y) = (0.5 * side_m * (scene.signed() + 1.0), 0.5 * side_m * (scene.signed() + 1.0));
        let query = scene.pose(x, y, 10f64.to_radians());
        let frame = NewKeyframe {
            id: KeyframeId(number as u64),
            frame: number as u64,
            time_s: number as f64,
            segment: number,
            pose: GroundPose::level(HEIGHT_M).with_mount_of(&query),
            covariance: Matrix6::zeros(),
            systematic: Matrix6::zeros(),
            tie: None,
            image: scene.picture(&query, true),
            mask: None,
            ground: None,
        };
        truth.push(query);
        let known = mapper.closures().len();
        let begun = busy_ms();
        mapper.take(KeyframeEvent::Made(Box::new(frame)), None, &mut images)?;
        times_ms.push(busy_ms() - begun);
        let Some(MapEdge { to, motion, .. }) = mapper.closures().get(known).map(|found| found.edge) else {
            continue;
        };
        let query_from_keyframe = Se2::new(motion[0], motion[1], motion[2]);
        let found = truth[to.0 as usize].se2() * query_from_keyframe.inverse();
        let off_m = (found.x_m - query.x_m).hypot(found.y_m - query.y_m);
        // A position error above five spots counts as another place.
        if off_m > 5.0 * scene.config.spot_m {
            wrong += 1;
            continue;
        }
        off_mm.push(1e3 * off_m);
        off_deg.push(wrap_angle(found.heading_rad - query.heading_rad).abs().to_degrees());
    }
    println!(
        "{name:9} {} keyframes over {area_m2} m²: {:.1} % of {queries} pictures found, {wrong} elsewhere; off {:.2} mm {:.3}° (median)  {:.2} mm {:.3}° (95 %); \
         {:.1} ms (median), {:.1} ms (95 %), {:.1} ms (most)",
        in_map,
        100.0 * off_mm.len() as f64 / queries as f64,
        quantile(&mut off_mm, 0.5),
        quantile(&mut off_deg, 0.5),
        quantile(&mut off_mm, 0.95),
        quantile(&mut off_deg, 0.95),
        quantile(&mut times_ms, 0.5),
        quantile(&mut times_ms, 0.95),
        quantile(&mut times_ms, 1.0),
    );
    Ok(())
}

/// Maximum number of queries.
const QUERIES: usize = 1000;

fn unknown(name: &str, seed: u64) -> Result<()> {
    let mut scene = ExampleScene::new(name, 320, seed)?;
    let keyframes = field(&mut scene, 6.5, 0.3);
    let signatures: Vec<_> = keyframes.iter().map(|keyframe| scene.signature(keyframe, false).0).collect();
    let indexed = |signatures: &[Signature]| {
        let mut index = PlaceIndex::new(&scene.config);
        for (number, signature) in signatures.iter().enumerate() {
            index.insert(KeyframeId(number as u64), signature);
        }
        index
    };
    let maps: Vec<_> = signatures.chunks(10).map(indexed).chain([indexed(&signatures)]).collect();
    // 50 m away, on other ground.
    let mut queries = field(&mut scene, 6.5, 0.3);
    queries.iter_mut().for_each(|query| query.x_m += 50.0);
    let (mut asked, mut taken, mut most) = (0, 0, 0.0f64);
    for query in &queries {
        let signature = scene.signature(query, true).0;
        for map in &maps {
            let found = map.query(&signature, 3);
            asked += 1;
            taken += found.iter().filter(|hypothesis| hypothesis.is_sure()).count();
            let firm = found.iter().filter(|h| h.worth >= 2.0 * h.rival_worth).map(|h| h.worth);
            most = firm.fold(most, f64::max);
        }
    }
    println!(
        "{name:9} {} keyframes, {} pictures of other ground, {asked} queries: {taken} sure; matches worth at most {most:.1}",
        keyframes.len(),
        queries.len()
    );
    Ok(())
}

fn speed(name: &str, seed: u64) -> Result<()> {
    let mut scene = ExampleScene::new(name, 320, seed)?;
    let mut index = PlaceIndex::new(&scene.config);
    let keyframes = field(&mut scene, 10.0, 0.5);
    for (number, keyframe) in keyframes.iter().enumerate() {
        let mut signature = scene.signature(keyframe, false).0;
        for copy in 0..25 {
            index.insert(KeyframeId((copy * keyframes.len() + number) as u64), &signature);
            let mask = [(); 4].map(|()| scene.random.bits());
            for feature in &mut signature.features {
                feature.descriptor.iter_mut().zip(mask).for_each(|(word, mask)| *word ^= mask);
            }
        }
    }
    let mut score = Score::default();
    for i in 0..200 {
        let near = keyframes[i * keyframes.len() / 200];
        let query = scene.pose(near.x_m + 0.2, near.y_m + 0.2, 0.1);
        let (signature, ms) = scene.signature(&query, true);
        score.signature_ms.push(ms);
        let begun = busy_ms();
        let found = index.query(&signature, 3);
        score.query_ms.push(busy_ms() - begun);
        score.queries += 1;
        score.sure += usize::from(found.iter().any(PlaceHypothesis::is_sure));
    }
    println!(
        "{name:9} {} keyframes: query {:.2} ms (median), {:.2} ms (95 %), {:.2} ms (most); sure of {} of {}; signature {:.2} ms",
        index.len(),
        quantile(&mut score.query_ms, 0.5),
        quantile(&mut score.query_ms, 0.95),
        quantile(&mut score.query_ms, 1.0),
        score.sure,
        score.queries,
        quantile(&mut score.signature_ms, 0.5),
    );
    Ok(())
}

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let what = words.first().map_or("recall", String::as_str);
    let named = |word: &&String| !word.contains('=');
    let seed = words.iter().find_map(|word| word.strip_prefix("seed=")?.parse().ok()).unwrap_or(0);
    let area_m2 = words.iter().find_map(|word| word.strip_prefix("area=")?.parse().ok()).unwrap_or(1000.0);
    let chosen: Vec<&String> = words.iter().skip(1).filter(named).collect();
    let grounds = Texture::names()
        .chain([REPEATING])
        .filter(|name| chosen.is_empty() || chosen.iter().any(|word| word == name));
    for name in grounds {
        match what {
            "unknown" => unknown(name, seed)?,
            "kidnapped" => kidnapped(name, seed, area_m2)?,
            "speed" => speed(name, seed)?,
            _ => recall(name, seed)?,
        }
    }
    Ok(())
}
