//! `odograph map info`: what a map holds.

use super::root;
use crate::commands::run::losses;
use crate::{Outcome, console};
use odograph::camera::{Camera, Rig};
use odograph::error::Result;
use odograph::formats::decimal::Rounded;
use odograph::ground_map::GroundMap;
use odograph::keyframe::{EdgeKind, KeyframeId};
use odograph::trajectory::{LossReason, LostStretch};
use odograph_map::{MapClaim, MapFile, MapLandmark, PathFrame, SessionOrigin, connected_stretches};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Show what a map holds.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct MapInfoArguments {
    /// The map.
    #[arg(value_name = "MAP")]
    map: PathBuf,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
    /// Check the whole file for damage, every image included; slow on a large map.
    #[arg(long)]
    check: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph map info drive/map.gpkg
  odograph map info hall.gpkg --check";

/// The facts about a map.
#[derive(Debug, Serialize)]
struct MapInfo {
    file: String,
    bytes: u64,
    image_bytes: u64,
    camera: Camera,
    rig: Rig,
    sessions: Vec<SessionInfo>,
    keyframes: usize,
    odometry_edges: usize,
    gap_edges: usize,
    loop_edges: usize,
    /// Parts of the map that no edge connects.
    pieces: usize,
    features: usize,
    /// Least x and y, greatest x and y of the keyframes.
    extent_m: Option<[f64; 4]>,
    mosaic: Option<MosaicInfo>,
    /// The markers on the ground, by family, number and place; left out in a map without any.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    markers: Vec<MarkerInfo>,
}

/// A marker at a place, as all its sightings have it.
#[derive(Debug, Serialize)]
struct MarkerInfo {
    family: String,
    size_m: f64,
    number: u32,
    /// Mean of its sightings.
    x_m: f64,
    y_m: f64,
    /// Standard deviation of x and y in the map, by the best of its sightings, metres.
    sigma_m: f64,
    sightings: usize,
    sessions: Vec<u32>,
    /// Time of its last sighting in its session, seconds.
    last_s: f64,
}

#[derive(Debug, Serialize)]
struct SessionInfo {
    id: u32,
    source: String,
    keyframes: usize,
    frames: usize,
    path_m: f64,
    /// Whether its run did not end, and left no path.
    unfinished: bool,
    /// Fraction of its images that does not show the ground, 0 to 1; left out where there is none.
    #[serde(skip_serializing_if = "Option::is_none")]
    masked: Option<f64>,
    /// When its camera was lost, and why; left out where it never was.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    losses: Vec<LossInfo>,
    start_s: Option<f64>,
    end_s: Option<f64>,
    /// The robot that recorded it, if it has a name.
    #[serde(skip_serializing_if = "Option::is_none")]
    origin: Option<OriginInfo>,
    /// Its camera and mount, where they are not those of the map.
    #[serde(skip_serializing_if = "Option::is_none")]
    camera: Option<Camera>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rig: Option<Rig>,
}

/// An interval without a pose.
#[derive(Debug, Serialize)]
struct LossInfo {
    start_s: f64,
    end_s: f64,
    frames: u64,
    reasons: Vec<LossReason>,
}

/// The name of a session that is the same in every map: its keyframes are numbered in it.
#[derive(Debug, Serialize)]
struct OriginInfo {
    robot: String,
    key: String,
    first_number: Option<u64>,
    last_number: Option<u64>,
}

impl LossInfo {
    fn of(stretch: LostStretch) -> Self {
        let LostStretch { from_s, to_s, frames, reasons } = stretch;
        Self { start_s: from_s, end_s: to_s, frames, reasons }
    }

    /// With times since this one.
    fn stretch(&self, begin_s: f64) -> LostStretch {
        let (from_s, to_s) = (self.start_s - begin_s, self.end_s - begin_s);
        LostStretch { from_s, to_s, frames: self.frames, reasons: self.reasons.clone() }
    }
}

#[derive(Debug, Serialize)]
struct MosaicInfo {
    metres_per_pixel: f64,
    width_px: u64,
    height_px: u64,
    levels: u32,
    /// How far keyframes have moved since it was rendered, if that is visible.
    #[serde(skip_serializing_if = "Option::is_none")]
    shift_m: Option<f64>,
}

/// Runs the command.
pub fn info(arguments: &MapInfoArguments) -> Result<Outcome> {
    let mut file = MapFile::open_read_only(&arguments.map)?;
    if arguments.check {
        file.check()?;
    }
    let info = gathered(&file)?;
    if arguments.json {
        console::print_json("the facts about the map", &info)?;
    } else {
        console::print(&described(&info, arguments.check))?;
    }
    Ok(Outcome::Done)
}

fn gathered(file: &MapFile) -> Result<MapInfo> {
    let map = file.map()?;
    let unfinished: Vec<u32> = file.unfinished_sessions()?.iter().map(|session| session.id).collect();
    let sessions = file
        .sessions()?
        .into_iter()
        .map(|session| {
            let path = file.path_of(session.id)?;
            let other = map.other_cameras.get(&session.id);
            let mut own = map.keyframes.iter().filter(|keyframe| keyframe.session == session.id);
            let ends = [own.clone().next(), own.next_back()];
            let [first_number, last_number] =
                ends.map(|keyframe| keyframe.map_or(Ok(None), |keyframe| file.number_of(keyframe.id)));
            let (first_number, last_number) = (first_number?, last_number?);
            let named = |origin: SessionOrigin| OriginInfo {
                robot: origin.robot,
                key: origin.key,
                first_number,
                last_number,
            };
            Ok(SessionInfo {
                origin: session.origin.map(named),
                camera: other.map(|other| other.camera.clone()),
                rig: other.map(|other| other.rig),
                id: session.id,
                source: session.source,
                keyframes: map.keyframes.iter().filter(|keyframe| keyframe.session == session.id).count(),
                frames: path.len(),
                path_m: over_ground_m(connected_stretches(&path)),
                unfinished: unfinished.contains(&session.id),
                losses: file.losses_of(session.id)?.into_iter().map(LossInfo::of).collect(),
                masked: map.masks.get(&session.id).map(|mask| mask.share()),
                start_s: path.first().map(|frame| frame.time_s),
                end_s: path.last().map(|frame| frame.time_s),
            })
        })
        .collect::<Result<Vec<_>>>()?;
    let shift_m = file.mosaic_shift_m()?;
    let mosaic = file.mosaic()?.map(|layer| {
        let (width_px, height_px, _) = layer.picture_at(layer.finest);
        let (metres_per_pixel, levels) = (layer.resolution_m, layer.finest + 1);
        MosaicInfo { metres_per_pixel, width_px, height_px, levels, shift_m }
    });
    let edges = |kind| map.edges.iter().filter(|edge| edge.kind == kind).count();
    Ok(MapInfo {
        file: file.path().display().to_string(),
        bytes: size(file.path()) + size(&written_ahead(file.path())),
        image_bytes: file.image_bytes()?.1,
        camera: map.camera.clone(),
        rig: map.rig,
        sessions,
        keyframes: map.keyframes.len(),
        odometry_edges: edges(EdgeKind::Odometry),
        gap_edges: edges(EdgeKind::Gap),
        loop_edges: edges(EdgeKind::Loop),
        pieces: pieces(&map),
        features: map.keyframes.iter().map(|keyframe| keyframe.signature.features.len()).sum(),
        extent_m: extent_m(&map),
        mosaic,
        markers: markers(file.landmarks()?),
    })
}

fn markers(landmarks: Vec<MapLandmark>) -> Vec<MarkerInfo> {
    let info = |landmark: MapLandmark| MarkerInfo {
        family: landmark.family,
        size_m: landmark.size_m,
        number: landmark.number,
        x_m: landmark.pose.x_m,
        y_m: landmark.pose.y_m,
        sigma_m: landmark.sigma_m,
        sightings: landmark.sightings,
        sessions: landmark.sessions,
        last_s: landmark.last_s,
    };
    landmarks.into_iter().map(info).collect()
}

/// Length of connected stretches over the ground, metres: what `odograph run` calls its distance.
pub fn over_ground_m<'a>(stretches: impl Iterator<Item = &'a [PathFrame]>) -> f64 {
    let steps = stretches.flat_map(|stretch| stretch.windows(2));
    // A fold: the sum of no numbers is −0.
    steps.map(|two| two[0].pose.distance_m(&two[1].pose)).fold(0.0, |a, b| a + b)
}

fn extent_m(map: &GroundMap) -> Option<[f64; 4]> {
    map.keyframes
        .iter()
        .map(|keyframe| [keyframe.pose.x_m, keyframe.pose.y_m, keyframe.pose.x_m, keyframe.pose.y_m])
        .reduce(|a, b| [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])])
}

/// What to know of a mosaic that is older than the poses of the keyframes.
pub fn stale(shift_m: f64, map: &Path) -> String {
    format!(
        "older than the poses, which have moved by up to {:.1} mm since; odograph map mosaic {} renders it again",
        1e3 * shift_m,
        console::name(map)
    )
}

/// Number of parts that the edges leave.
pub fn pieces(map: &GroundMap) -> usize {
    let place: BTreeMap<KeyframeId, usize> =
        map.keyframes.iter().enumerate().map(|(index, keyframe)| (keyframe.id, index)).collect();
    let mut leader: Vec<usize> = (0..place.len()).collect();
    let mut pieces = place.len();
    for edge in &map.edges {
        let (Some(&from), Some(&to)) = (place.get(&edge.from), place.get(&edge.to)) else { continue };
        let (from, to) = (root(&mut leader, from), root(&mut leader, to));
        if from != to {
            leader[from] = to;
            pieces -= 1;
        }
    }
    pieces
}

fn described(info: &MapInfo, checked: bool) -> String {
    let mut text = String::new();
    let megabytes = |bytes: u64| bytes as f64 / 1e6;
    let _ = writeln!(
        text,
        "{}: {:.1} MB, {:.1} MB of them images",
        console::name(&info.file),
        megabytes(info.bytes),
        megabytes(info.image_bytes)
    );
    let _ = writeln!(text, "camera     {}", mounted(&info.camera, &info.rig));
    let _ = writeln!(
        text,
        "keyframes  {} in {}, {} features",
        info.keyframes,
        counted(info.pieces, "piece"),
        info.features
    );
    let _ = writeln!(
        text,
        "edges      {} odometry, {}, {}",
        info.odometry_edges,
        counted(info.gap_edges, "gap"),
        counted(info.loop_edges, "loop")
    );
    if let Some([left, bottom, right, top]) = info.extent_m.map(|ends| ends.map(Rounded)) {
        let _ = writeln!(text, "extent     x {left:.2} to {right:.2} m, y {bottom:.2} to {top:.2} m");
    }
    match &info.mosaic {
        Some(mosaic) => {
            let _ = writeln!(
                text,
                "mosaic     {}x{} px of {:.2} mm, {} levels",
                mosaic.width_px,
                mosaic.height_px,
                1000.0 * mosaic.metres_per_pixel,
                mosaic.levels
            );
            if let Some(shift_m) = mosaic.shift_m {
                let _ = writeln!(text, "           {}", stale(shift_m, Path::new(&info.file)));
            }
        }
        None => text.push_str("mosaic     none; odograph map mosaic renders it\n"),
    }
    info.markers.iter().for_each(|marker| describe_marker(marker, &mut text));
    info.sessions.iter().for_each(|session| describe_session(session, info, &mut text));
    if checked {
        text.push_str("checked    no damage found\n");
    }
    text
}

fn describe_marker(marker: &MarkerInfo, text: &mut String) {
    let sessions: Vec<String> = marker.sessions.iter().map(ToString::to_string).collect();
    let _ = writeln!(
        text,
        "marker {:<3} {}:{}mm at x {:.3} m, y {:.3} m, ± {:.1} mm; seen {}, session{} {}",
        marker.number,
        marker.family,
        (1e6 * marker.size_m).round() / 1e3,
        Rounded(marker.x_m),
        Rounded(marker.y_m),
        1e3 * marker.sigma_m,
        counted(marker.sightings, "time"),
        if sessions.len() == 1 { "" } else { "s" },
        sessions.join(", ")
    );
}

fn describe_session(session: &SessionInfo, info: &MapInfo, text: &mut String) {
    let _ = writeln!(
        text,
        "session {}  {}: {}, {}, {:.2} m",
        session.id,
        console::source(&session.source),
        counted(session.keyframes, "keyframe"),
        counted(session.frames, "frame"),
        session.path_m
    );
    if session.unfinished {
        let _ = writeln!(text, "           {}", unfinished(info));
    }
    // Times are since the first frame, as a run prints them.
    let begin_s = session.losses.iter().map(|loss| loss.start_s).chain(session.start_s).reduce(f64::min);
    let lost: Vec<LostStretch> =
        session.losses.iter().map(|loss| loss.stretch(begin_s.unwrap_or(0.0))).collect();
    for line in losses(&lost, "--json lists") {
        let _ = writeln!(text, "           {line}");
    }
    if let Some(share) = session.masked {
        let _ = writeln!(
            text,
            "           {:.0} % of its images is masked: it does not show the ground",
            100.0 * share
        );
    }
    if let Some(origin) = &session.origin {
        let numbers = match (origin.first_number, origin.last_number) {
            (Some(first), Some(last)) => format!(", keyframes {first} to {last}"),
            _ => String::new(),
        };
        let _ = writeln!(text, "           by {}, session {}{numbers}", origin.robot, origin.key);
    }
    if let (Some(camera), Some(rig)) = (&session.camera, &session.rig) {
        let _ = writeln!(text, "           camera {}", mounted(camera, rig));
    }
}

/// A camera and its mount in a line.
fn mounted(camera: &Camera, rig: &Rig) -> String {
    let (fx, fy) = camera.focal_px();
    format!(
        "{}x{}, focal lengths {fx:.1} and {fy:.1} px, {:.3} m above the ground",
        camera.width(),
        camera.height(),
        rig.height_m
    )
}

/// A number of things, with the plural of a regular noun.
fn counted(count: usize, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

/// What is known about a session whose run did not end.
fn unfinished(info: &MapInfo) -> String {
    let shown = console::name(&info.file);
    match MapClaim::is_held(Path::new(&info.file)) {
        true => "is being recorded, or its run was killed; a path is written at the end of a run".to_owned(),
        false => format!(
            "did not end: it has no path, its keyframes are used; odograph run --resume FOLDER (its results) runs it\n\
             \x20          again, odograph map repair {shown} --drop-unfinished writes the map without it"
        ),
    }
}

/// Size of a file, bytes; 0 where there is none.
fn size(path: &Path) -> u64 {
    path.metadata().map_or(0, |metadata| metadata.len())
}

/// The log beside a map that another program is writing.
fn written_ahead(map: &Path) -> PathBuf {
    let mut log = map.as_os_str().to_owned();
    log.push("-wal");
    log.into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use odograph::geometry::GroundPose;

    #[test]
    fn what_rounds_to_zero_has_no_sign() {
        let marker = MarkerInfo {
            family: "apriltag:36h11".to_owned(),
            size_m: 0.08,
            number: 7,
            x_m: -0.0004,
            y_m: -1.25,
            sigma_m: 0.001,
            sightings: 1,
            sessions: vec![0],
            last_s: 1.0,
        };
        let mut text = String::new();
        describe_marker(&marker, &mut text);
        assert!(text.contains("x 0.000 m, y -1.250 m, ± 1.0 mm; seen 1 time, session 0"), "{text}");
    }

    #[test]
    fn the_length_is_that_of_a_run() {
        let at = |frame: u64, segment: usize, x_m: f64, height_m: f64| PathFrame {
            frame,
            segment,
            time_s: frame as f64,
            pose: GroundPose { x_m, ..GroundPose::level(height_m) },
        };
        // A metre, up and down; a gap of ten; half a metre.
        let frames = [at(0, 0, 0.0, 1.0), at(1, 0, 1.0, 2.0), at(2, 1, 11.0, 1.0), at(3, 1, 11.5, 1.0)];
        assert_eq!(over_ground_m(connected_stretches(&frames)), 1.5);
        assert_eq!(over_ground_m(connected_stretches(&frames[..1])).to_string(), "0");
        // The same gap, after which the ground was recognised: the segment goes on.
        let recognised = [at(0, 0, 0.0, 1.0), at(1, 0, 1.0, 2.0), at(5, 0, 11.0, 1.0), at(6, 0, 11.5, 1.0)];
        assert_eq!(over_ground_m(connected_stretches(&recognised)), 1.5);
    }
}
