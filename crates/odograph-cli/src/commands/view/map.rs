//! A map file in the browser: the paths of its sessions, its keyframes and what ties them, and its
//! mosaic.

use odograph::error::{Error, Result};
use odograph::geometry::GroundPose;
use odograph::ground_map::MapKeyframe;
use odograph::mosaic::{MapMosaic, Mosaic, MosaicSquare};
use odograph::trajectory::LostStretch;
use odograph_live::ground::GrowingTiles;
use odograph_live::{GroundPicture, Mark, TiledGround, TrackRecord};
use odograph_map::{MapFile, PathFrame, connected_stretches};
use odograph_session::live::{map_graph, map_markers};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

/// A ground that is rendered while it is looked at has no more squares: 256 MB of memory. One that
/// would have is made coarser.
const MAX_SQUARES: usize = 1024;
/// Between two sessions on the slider, seconds.
const PAUSE_S: f64 = 1.0;

/// What there is to see of a map.
pub struct MapView {
    pub records: Vec<TrackRecord>,
    /// Where each session begins.
    pub sessions: Vec<Mark>,
    /// Keyframes, and the loops between them.
    pub graph: Value,
    /// The markers on the ground.
    pub markers: Value,
    pub source: String,
    pub size: (usize, usize),
    pub height_m: f64,
}

impl MapView {
    /// Reads a map. A session that was killed, and has no path, is shown as its keyframes.
    pub fn read(path: &Path) -> Result<Self> {
        let file = MapFile::open_read_only(path)?;
        let map = file.map()?;
        if map.keyframes.is_empty() {
            return Err(Error::input(format!("{}: there is nothing in this map yet", path.display())));
        }
        let mut keyframes: BTreeMap<u32, Vec<&MapKeyframe>> = BTreeMap::new();
        map.keyframes
            .iter()
            .for_each(|keyframe| keyframes.entry(keyframe.session).or_default().push(keyframe));
        let (mut records, mut sessions, mut sources) = (Vec::new(), Vec::new(), Vec::new());
        let mut segments = 0;
        for session in file.sessions()? {
            let own = keyframes.remove(&session.id).unwrap_or_default();
            let mut frames = file.path_of(session.id)?;
            let stretches: Vec<&[PathFrame]> = if frames.is_empty() {
                frames = own.iter().map(|keyframe| frame_of(keyframe)).collect();
                frames.chunk_by(|a, b| a.segment == b.segment).collect()
            } else {
                connected_stretches(&frames).collect()
            };
            let Some(first) = frames.first() else { continue };
            let begin_s =
                records.last().map_or(0.0, |last: &TrackRecord| f64::from(last.values[0]) + PAUSE_S);
            sessions.push(Mark {
                record: records.len(),
                time_s: begin_s as f32,
                x_m: Some(first.pose.x_m as f32),
                y_m: Some(first.pose.y_m as f32),
                name: session.source.rsplit(['/', '\\']).next().unwrap_or_default().to_owned(),
            });
            sources.push(session.source.clone());
            let losses = file.losses_of(session.id)?;
            let first_s = losses.first().map_or(first.time_s, |loss| loss.from_s.min(first.time_s));
            let shift_s = begin_s - first_s;
            records.extend(records_of(&stretches, &own, &losses, shift_s, segments));
            segments += frames.last().map_or(0, |last| last.segment) + 1;
        }
        let camera = &map.camera;
        Ok(Self {
            graph: map_graph(&map),
            markers: map_markers(file.landmarks()?.into_iter().map(|at| (at.number, at.pose))),
            records,
            sessions,
            source: sources.join(", "),
            size: (camera.width(), camera.height()),
            height_m: map.rig.height_m,
        })
    }
}

fn frame_of(keyframe: &MapKeyframe) -> PathFrame {
    let MapKeyframe { frame, segment, time_s, pose, .. } = *keyframe;
    PathFrame { frame, segment, time_s, pose }
}

/// The frames of a session in connected stretches. How well each is known is what its keyframe
/// before it says.
fn records_of(
    stretches: &[&[PathFrame]],
    keyframes: &[&MapKeyframe],
    losses: &[LostStretch],
    shift_s: f64,
    segments: usize,
) -> Vec<TrackRecord> {
    let speed = |stretch: &[PathFrame], k: usize| {
        let (a, b) = (&stretch[k.saturating_sub(1)], &stretch[(k + 1).min(stretch.len() - 1)]);
        let way = b.pose.distance_m(&a.pose);
        if b.time_s > a.time_s { way / (b.time_s - a.time_s) } else { f64::NAN }
    };
    let record = |frame: &PathFrame, speed_m_s: f64| {
        let GroundPose { x_m, y_m, heading_rad, .. } = frame.pose;
        let known = keyframes.partition_point(|keyframe| keyframe.frame <= frame.frame);
        let covariance = keyframes.get(known.saturating_sub(1)).map(|keyframe| keyframe.covariance);
        let entry = |row, column| covariance.map_or(f64::NAN, |covariance| covariance[(row, column)]);
        let mut values = [f32::NAN; TrackRecord::LENGTH];
        let numbers = [
            frame.time_s + shift_s,
            x_m,
            y_m,
            heading_rad,
            entry(0, 0),
            entry(0, 1),
            entry(1, 1),
            entry(2, 2).max(0.0).sqrt(),
            speed_m_s,
            0.0,
            (segments + frame.segment) as f64,
        ];
        values.iter_mut().zip(numbers).for_each(|(value, number)| *value = number as f32);
        TrackRecord { values }
    };
    let mut records = Vec::new();
    let mut before: Option<&PathFrame> = None;
    for stretch in stretches {
        let between = (before.map(|frame| frame.time_s), stretch.first().map(|frame| frame.time_s));
        records.extend(lost_between(between, losses, shift_s));
        records.extend(stretch.iter().enumerate().map(|(k, frame)| record(frame, speed(stretch, k))));
        before = stretch.last();
    }
    records.extend(lost_between((before.map(|frame| frame.time_s), None), losses, shift_s));
    records
}

/// The records between two stretches, or at the end of a session, where its camera was lost: for
/// each loss its first and last frame. The page draws no line over a record without a pose.
fn lost_between(
    (from_s, to_s): (Option<f64>, Option<f64>),
    losses: &[LostStretch],
    shift_s: f64,
) -> Vec<TrackRecord> {
    let is_between = |loss: &&LostStretch| {
        from_s.is_none_or(|from_s| loss.from_s > from_s) && to_s.is_none_or(|to_s| loss.to_s <= to_s)
    };
    let ends = |loss: &LostStretch| {
        let interval_s = (loss.to_s - loss.from_s) / loss.frames.max(1) as f64;
        [loss.from_s, loss.to_s - interval_s]
            .map(|time_s| TrackRecord::lost(time_s + shift_s, loss.reasons.first().copied()))
    };
    let mut records: Vec<TrackRecord> = losses.iter().filter(is_between).flat_map(ends).collect();
    // An older map does not say why frames are missing.
    if let (true, Some(from_s), Some(to_s)) = (records.is_empty(), from_s, to_s) {
        records.push(TrackRecord::lost(0.5 * (from_s + to_s) + shift_s, None));
    }
    records
}

/// The mosaic that the map has; where it has none it is rendered while it is looked at.
pub fn ground(path: &Path, most_pixels: usize, ended: &Arc<AtomicBool>) -> Result<Arc<dyn TiledGround>> {
    let file = MapFile::open_read_only(path)?;
    if let Some(picture) = file.mosaic_picture(most_pixels)? {
        let picture = GroundPicture::new(picture.rgba, picture.width, picture.height, picture.placement)?;
        return Ok(Arc::new(picture));
    }
    let tiles = Arc::new(GrowingTiles::default());
    thread::spawn({
        let (tiles, ended) = (Arc::clone(&tiles), Arc::clone(ended));
        // Where it fails what is rendered stays: paths and keyframes can be looked at without.
        move || drop(render(file, &tiles, &ended))
    });
    Ok(tiles)
}

fn render(mut file: MapFile, tiles: &GrowingTiles, ended: &AtomicBool) -> Result<()> {
    let map = file.map()?;
    let mut resolution_m = None;
    'coarser: while let Some(mut rendering) = MapMosaic::new(&map, &mut file, resolution_m)? {
        tiles.begin(rendering.resolution_m());
        while let Some(rendered) = rendering.next_tiles(&mut file)? {
            if ended.load(Ordering::Relaxed) {
                return Ok(());
            }
            for tile in rendered {
                tiles.put(MosaicSquare { column: tile.column, row: tile.row }, tile.rgba);
            }
            if tiles.count() > MAX_SQUARES {
                resolution_m = Some(2.0 * rendering.resolution_m());
                continue 'coarser;
            }
        }
        return Ok(());
    }
    Ok(())
}

/// Both kinds of mosaic have squares of one size.
const _: () = assert!(odograph::mosaic::MOSAIC_TILE_PX == Mosaic::TILE_SIDE_PX);

#[cfg(test)]
mod tests {
    use super::*;
    use odograph::trajectory::LossReason;

    #[test]
    fn between_two_stretches_there_is_no_pose() {
        let frames: Vec<PathFrame> = (0..10)
            .chain(40..50)
            .map(|frame| PathFrame {
                frame,
                segment: 0,
                time_s: 0.1 * frame as f64,
                pose: GroundPose { x_m: 0.01 * frame as f64, ..GroundPose::level(1.0) },
            })
            .collect();
        let stretches: Vec<&[PathFrame]> = connected_stretches(&frames).collect();
        let records = records_of(&stretches, &[], &[], 5.0, 0);
        let [time_s, x_m, speed_m_s] = [0, 1, 8].map(|field| records.iter().map(move |r| r.values[field]));
        assert_eq!(x_m.clone().map(f32::is_nan).collect::<Vec<_>>().iter().filter(|nan| **nan).count(), 1);
        assert!(x_m.clone().nth(10).is_some_and(f32::is_nan));
        assert!(time_s.clone().nth(10).is_some_and(|time_s| (time_s - 7.45).abs() < 1e-3));
        // No speed over the gap.
        assert!(speed_m_s.filter(|speed| !speed.is_nan()).all(|speed| (speed - 0.1).abs() < 1e-3));
        // A map that says why has the first and the last lost frame of each loss, in order.
        let loss = |from_s, to_s, frames, reason| LostStretch { from_s, to_s, frames, reasons: vec![reason] };
        let losses = [loss(1.0, 4.0, 30, LossReason::Dark), loss(5.0, 5.2, 3, LossReason::Blur)];
        let records = records_of(&stretches, &[], &losses, 5.0, 0);
        let lost: Vec<[f32; 2]> = records
            .iter()
            .filter(|record| record.values[1].is_nan())
            .map(|record| [record.values[0], record.values[9]])
            .collect();
        for (found, expected) in lost.iter().zip([[6.0, 4.0], [8.9, 4.0], [10.0, 5.0], [10.1333, 5.0]]) {
            assert!((0..2).all(|i| (found[i] - expected[i]).abs() < 1e-3), "{lost:?}");
        }
        assert_eq!(lost.len(), 4);
        assert!(records.windows(2).all(|pair| pair[0].values[0] < pair[1].values[0]));
    }
}
