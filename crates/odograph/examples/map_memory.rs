//! Memory of a fleet's map, and the time of a look-up in it.
//!
//! `cargo run --release -p odograph --example map_memory -- [keyframes …]`
//!
//! The keyframes are 400 images of rendered asphalt and copies of them whose descriptors are XORed
//! with a constant, as in the example `places`. Memory is the resident memory of the process that a
//! [`FleetMapper`] with the map adds (Linux). Queries show the ground of a keyframe from elsewhere.
//! The last figure is a hash of all their hypotheses, to the last bit.

#![allow(clippy::print_stdout)] // prints a table

mod processor_time;

use nalgebra::Matrix6;
use odograph::camera::{Camera, Distortion, Rig};
use odograph::error::Result;
use odograph::geometry::GroundPose;
use odograph::ground_map::{GroundMap, MapKeyframe};
use odograph::image::Pyramid;
use odograph::keyframe::KeyframeId;
use odograph::motion::Random;
use odograph::odometry::OdometryConfig;
use odograph::place_recognition::{PlaceHypothesis, PlaceIndex, PlacesConfig, Signature};
use odograph::slam::FleetMapper;
use odograph_simulation::{Ground, Renderer, Texture};
use processor_time::busy_ms;
use std::hash::{DefaultHasher, Hash, Hasher};

const HEIGHT_M: f64 = 0.75;
/// Number of rendered keyframes, on a grid.
const RENDERED: usize = 400;

/// Resident memory of this process, bytes; 0 where the system does not tell it.
fn resident() -> usize {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    let pages = statm.split(' ').nth(1).and_then(|pages| pages.parse::<usize>().ok());
    pages.unwrap_or(0) * 4096
}

/// The signatures of a map of `count` keyframes, one at a time.
fn signatures(rendered: &[Signature], count: usize) -> impl Iterator<Item = Signature> + '_ {
    let mut random = Random::new(11);
    let mut masks = [[0; 4]; RENDERED];
    (0..count).map(move |number| {
        let mut signature = rendered[number % RENDERED].clone();
        let mask = &mut masks[number % RENDERED];
        for feature in &mut signature.features {
            feature.descriptor.iter_mut().zip(&*mask).for_each(|(word, mask)| *word ^= mask);
        }
        *mask = [(); 4].map(|()| random.bits());
        signature
    })
}

fn main() -> Result<()> {
    let camera = Camera::new((320, 240), (250.0, 250.0), (159.5, 119.5), Distortion::None)?;
    let renderer = Renderer::new(&camera);
    let ground = Ground::new(Texture::Asphalt, renderer.footprint_m(HEIGHT_M), false, 7)?;
    let config = PlacesConfig::new(&camera, HEIGHT_M);
    let pose = |number: usize, off_m: f64| {
        let (x_m, y_m) = (0.5 * (number % 20) as f64 + off_m, 0.5 * (number / 20) as f64 + off_m);
        GroundPose { x_m, y_m, heading_rad: number as f64, ..GroundPose::level(HEIGHT_M) }
    };
    let signature = |pose: &GroundPose| {
        let pyramid = Pyramid::new(renderer.gray_view(&ground, pose), 4);
        Signature::of(&pyramid, &camera, None, pose, &config)
    };
    let rendered: Vec<Signature> = (0..RENDERED).map(|number| signature(&pose(number, 0.0))).collect();
    let queries: Vec<Signature> =
        (0..RENDERED).step_by(2).map(|number| signature(&pose(number, 0.2))).collect();
    let given = std::env::args().skip(1).filter_map(|word| word.parse().ok());
    let mut counts: Vec<usize> = given.collect();
    if counts.is_empty() {
        counts = vec![1000, 10_000];
    }
    for count in counts {
        let mut map = GroundMap {
            camera: camera.clone(),
            rig: Rig::level(HEIGHT_M),
            other_cameras: Default::default(),
            masks: Default::default(),
            keyframes: Vec::new(),
            edges: Vec::new(),
        };
        let before = resident();
        map.keyframes.extend(signatures(&rendered, count).enumerate().map(|(number, signature)| {
            MapKeyframe {
                id: KeyframeId(number as u64),
                session: 0,
                segment: 0,
                frame: number as u64,
                time_s: number as f64,
                odometry_pose: pose(number, 0.0),
                pose: pose(number, 0.0),
                covariance: Matrix6::zeros(),
                signature,
            }
        }));
        let mapper = FleetMapper::new(map, &OdometryConfig::default());
        let held = resident().saturating_sub(before);
        drop(mapper);
        let mut index = PlaceIndex::new(&config);
        for (number, signature) in signatures(&rendered, count).enumerate() {
            index.insert(KeyframeId(number as u64), &signature);
        }
        let (mut times_ms, mut sure) = (Vec::new(), 0);
        let mut hypotheses = DefaultHasher::new();
        for query in &queries {
            let begun = busy_ms();
            let found = index.query(query, 3);
            times_ms.push(busy_ms() - begun);
            sure += usize::from(found.iter().any(PlaceHypothesis::is_sure));
            format!("{found:?}").hash(&mut hypotheses);
        }
        times_ms.sort_by(f64::total_cmp);
        println!(
            "{count} keyframes: {:.1} kB each, {:.0} MB in all; look-up {:.2} ms (median), {:.2} ms (95 %); sure of {sure} of {}; {:016x}",
            held as f64 / 1e3 / count as f64,
            held as f64 / 1e6,
            times_ms[times_ms.len() / 2],
            times_ms[times_ms.len() * 95 / 100],
            queries.len(),
            hypotheses.finish(),
        );
    }
    Ok(())
}
