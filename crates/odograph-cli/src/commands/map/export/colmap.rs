//! A map as COLMAP's text model: `cameras.txt`, `images.txt`, `points3D.txt` (its documentation,
//! "Output Format"), and the images.
//!
//! The points are the features that keyframes are recognised by; two keyframes joined by an edge
//! see the same point if their features have the same position on the ground and similar
//! descriptors.

use crate::commands::map::root;
use crate::{files, interrupt};
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::formats::camera_file::{CameraFormat, write_as};
use odograph::geometry::GroundPoint;
use odograph::ground_map::{GroundMap, KeyframeImages, MapKeyframe};
use odograph::keyframe::KeyframeId;
use odograph_map::MapFile;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

/// Largest Hamming distance, of 256 bits, between descriptors of the same point.
const MAX_BITS: u32 = 48;
/// Largest distance between features of the same point, pixels at the image centre.
const FARTHEST_PX: f64 = 4.0;
/// COLMAP's pixel (0.5, 0.5) is the centre of the top left one.
const PIXEL_CENTRE: f64 = 0.5;

/// Every file or folder that is written.
const OURS: [&str; 4] = ["cameras.txt", "images.txt", "points3D.txt", "images"];

/// A feature of a keyframe: where it is on the ground, and in the image.
struct KeyframeFeature {
    ground: GroundPoint,
    pixel: [f64; 2],
    descriptor: [u64; 4],
    /// Number of the point that it shows.
    point: usize,
}

/// Writes the folder and says what was written.
pub fn write(file: &mut MapFile, folder: &Path, force: bool) -> Result<String> {
    let map = file.map()?;
    if map.keyframes.is_empty() {
        return Err(Error::input(format!("{} has no keyframe to write", file.path().display())));
    }
    if !map.has_one_camera() {
        return Err(Error::input(format!(
            "{} was made with several cameras, and only maps of one camera are written for COLMAP",
            file.path().display()
        )));
    }
    let camera = write_as(&map.camera, CameraFormat::Colmap)?;
    files::check_output_names(folder, &OURS, force)?;
    let _made = files::MadeFolders::new(folder)?;
    let written = write_files(file, &map, &camera, folder);
    if written.is_err() && !force {
        OURS.iter().for_each(|name| files::remove(&folder.join(name)));
    }
    written
}

/// Writes the images, and then the texts about them.
fn write_files(file: &mut MapFile, map: &GroundMap, camera: &str, folder: &Path) -> Result<String> {
    let images = folder.join("images");
    files::make_folder(&images)?;
    let mut features: Vec<Vec<KeyframeFeature>> =
        map.keyframes.iter().map(|keyframe| seen(&map.camera, keyframe)).collect();
    let tracks = tracks(map, &mut features);
    let mut colors = BTreeMap::new();
    for (index, keyframe) in map.keyframes.iter().enumerate() {
        if interrupt::asked() {
            return Err(Error::output(format!("interrupted before {} was complete", folder.display())));
        }
        let image = file.load(keyframe.id)?;
        let bytes = match &image.color {
            Some(color) => files::png_from_rgb(color)?,
            None => files::png_from_gray(&image.gray)?,
        };
        files::write(&images.join(name(keyframe.id)), &bytes)?;
        for feature in &features[index] {
            let (x, y) = (feature.pixel[0].round() as usize, feature.pixel[1].round() as usize);
            colors.entry(feature.point).or_insert_with(|| match &image.color {
                Some(color) => color.pixel(x, y),
                None => [image.gray.row(y)[x]; 3],
            });
        }
    }
    files::write(&folder.join("cameras.txt"), camera.as_bytes())?;
    files::write(&folder.join("images.txt"), images_text(map, &features).as_bytes())?;
    files::write(&folder.join("points3D.txt"), points_text(map, &features, &tracks, &colors).as_bytes())?;
    Ok(format!("{} images, {} points", map.keyframes.len(), tracks.len()))
}

fn name(keyframe: KeyframeId) -> String {
    format!("keyframe-{:06}.png", keyframe.0)
}

/// The features of a keyframe that lie inside its image.
fn seen(camera: &Camera, keyframe: &MapKeyframe) -> Vec<KeyframeFeature> {
    // Positions of a signature are those for a camera over the origin with this height and tilt.
    let pose = &keyframe.pose;
    let feature = |feature: &odograph::place_recognition::GroundFeature| {
        let [x, y] = feature.position_m.map(f64::from);
        let ground = pose.se2().apply(GroundPoint::new(x, y));
        let pixel = camera.pixel_from_ray(pose.ray_from_ground(ground)?)?;
        camera.contains(pixel, 0.0).then_some(KeyframeFeature {
            ground,
            pixel: [pixel.x, pixel.y],
            descriptor: feature.descriptor,
            point: 0,
        })
    };
    keyframe.signature.features.iter().filter_map(feature).collect()
}

/// Joins the features that show the same point; gives the features of each point as (keyframe,
/// feature).
fn tracks(map: &GroundMap, features: &mut [Vec<KeyframeFeature>]) -> Vec<Vec<(usize, usize)>> {
    let place: BTreeMap<KeyframeId, usize> =
        map.keyframes.iter().enumerate().map(|(index, keyframe)| (keyframe.id, index)).collect();
    // The features of all keyframes in a row, each led by the first one known to show the same
    // point.
    let starts: Vec<usize> = features
        .iter()
        .scan(0, |sum, features| {
            let start = *sum;
            *sum += features.len();
            Some(start)
        })
        .collect();
    let mut leader: Vec<usize> = (0..features.iter().map(Vec::len).sum()).collect();
    for edge in &map.edges {
        let (Some(&one), Some(&other)) = (place.get(&edge.from), place.get(&edge.to)) else { continue };
        let farthest_m = FARTHEST_PX * map.keyframes[one].pose.height_m / map.camera.focal_px().0;
        for (a, b) in alike(&features[one], &features[other], farthest_m) {
            let (a, b) = (root(&mut leader, starts[one] + a), root(&mut leader, starts[other] + b));
            leader[a.max(b)] = a.min(b);
        }
    }
    let mut points: BTreeMap<usize, Vec<(usize, usize)>> = BTreeMap::new();
    for (keyframe, start) in starts.iter().enumerate() {
        for feature in 0..features[keyframe].len() {
            points.entry(root(&mut leader, start + feature)).or_default().push((keyframe, feature));
        }
    }
    let tracks: Vec<_> = points.into_values().collect();
    for (point, track) in tracks.iter().enumerate() {
        for &(keyframe, feature) in track {
            features[keyframe][feature].point = point;
        }
    }
    tracks
}

/// The pairs of features that are each other's best match, near enough and alike enough.
fn alike(one: &[KeyframeFeature], other: &[KeyframeFeature], farthest_m: f64) -> Vec<(usize, usize)> {
    let best = |from: &KeyframeFeature, among: &[KeyframeFeature]| {
        let near = among.iter().enumerate().filter(|(_, to)| from.ground.distance(to.ground) <= farthest_m);
        let bits = |to: &KeyframeFeature| {
            (0..4).map(|k| (from.descriptor[k] ^ to.descriptor[k]).count_ones()).sum::<u32>()
        };
        near.map(|(index, to)| (bits(to), index))
            .min()
            .filter(|(bits, _)| *bits <= MAX_BITS)
            .map(|(_, index)| index)
    };
    let there: Vec<Option<usize>> = one.iter().map(|feature| best(feature, other)).collect();
    let back: Vec<Option<usize>> = other.iter().map(|feature| best(feature, one)).collect();
    let pair = |(a, b): (usize, &Option<usize>)| (*b).filter(|&b| back[b] == Some(a)).map(|b| (a, b));
    there.iter().enumerate().filter_map(pair).collect()
}

fn images_text(map: &GroundMap, features: &[Vec<KeyframeFeature>]) -> String {
    let mut text = String::from(
        "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n\
         #   POINTS2D[] as (X, Y, POINT3D_ID)\n",
    );
    for (index, keyframe) in map.keyframes.iter().enumerate() {
        let camera_from_world = keyframe.pose.world_from_camera().inverse();
        let (q, t) = (camera_from_world.rotation.coords, camera_from_world.translation.vector);
        let _ = writeln!(
            text,
            "{} {:.12} {:.12} {:.12} {:.12} {:.9} {:.9} {:.9} 1 {}",
            index + 1,
            q.w,
            q.x,
            q.y,
            q.z,
            t.x,
            t.y,
            t.z,
            name(keyframe.id)
        );
        let points: Vec<String> = features[index]
            .iter()
            .map(|f| {
                format!("{:.3} {:.3} {}", f.pixel[0] + PIXEL_CENTRE, f.pixel[1] + PIXEL_CENTRE, f.point + 1)
            })
            .collect();
        let _ = writeln!(text, "{}", points.join(" "));
    }
    text
}

fn points_text(
    map: &GroundMap,
    features: &[Vec<KeyframeFeature>],
    tracks: &[Vec<(usize, usize)>],
    colors: &BTreeMap<usize, [u8; 3]>,
) -> String {
    let mut text = String::from(
        "# 3D point list with one line of data per point:\n#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n",
    );
    for (point, track) in tracks.iter().enumerate() {
        let at = |&(keyframe, feature): &(usize, usize)| features[keyframe][feature].ground;
        let count = track.len() as f64;
        let x_m = track.iter().map(|seen| at(seen).x_m).sum::<f64>() / count;
        let y_m = track.iter().map(|seen| at(seen).y_m).sum::<f64>() / count;
        let [red, green, blue] = colors.get(&point).copied().unwrap_or([128; 3]);
        // How far the point lies from its features, in pixels of the image's middle.
        let px_per_m = map.camera.focal_px().0 / map.keyframes[track[0].0].pose.height_m;
        let mean = GroundPoint::new(x_m, y_m);
        let error_px = px_per_m * track.iter().map(|seen| at(seen).distance(mean)).sum::<f64>() / count;
        let _ = write!(text, "{} {x_m:.6} {y_m:.6} 0 {red} {green} {blue} {error_px:.4}", point + 1);
        for (keyframe, feature) in track {
            let _ = write!(text, " {} {feature}", keyframe + 1);
        }
        text.push('\n');
    }
    text
}
