//! What the page shows besides the growing path and ground: elevations and the mask during the run,
//! and the results after it.

use super::ground::LiveGround;
use super::map_graph::{map_graph, map_markers};
use odograph::fixed_pattern::ImageMask;
use odograph::geometry::Sim2;
use odograph::odometry::Odometry;
use odograph_live::{GroundPicture, Hub, TrackRecord};
use odograph_map::MapFile;
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

/// A mosaic with more pixels is not shown after the run: it would take a quarter of a gigabyte.
const MAX_SHOWN_PIXELS: usize = 64 << 20;

/// Elevations that the page shows at most; beyond it, every other one is dropped.
const MAX_ELEVATIONS: usize = 4096;

/// Columns of the mask that the page shows.
const MASK_COLUMNS: usize = 64;

/// Where the ground is not flat, and what of the image is not ground. Both change with keyframes.
#[derive(Default)]
pub struct PageLayers {
    elevations: Elevations,
    mask_share: f64,
}

impl PageLayers {
    /// Shows what the newest keyframe adds.
    pub fn show(&mut self, odometry: &Odometry, hub: &Hub, map_from_odometry: &Sim2) {
        let rounded = |metres: f64| (1e3 * metres).round() / 1e3;
        let fresh = odometry.elevations();
        if !fresh.is_empty() {
            self.elevations.add(fresh.into_iter().map(|(point, elevation_m)| {
                let at = map_from_odometry.apply(point);
                [at.x_m, at.y_m, elevation_m].map(rounded)
            }));
            hub.notify("elevations", &self.elevations.places);
        }
        if odometry.masked_share() != self.mask_share
            && let Some(mask) = odometry.mask()
        {
            self.mask_share = odometry.masked_share();
            hub.notify("mask", &coarse(&mask));
        }
    }
}

/// A sample of bounded size of all places so far.
#[derive(Default)]
struct Elevations {
    /// x, y and elevation, metres.
    places: Vec<[f64; 3]>,
    /// How often the sample was halved.
    halvings: u32,
}

impl Elevations {
    fn add(&mut self, fresh: impl Iterator<Item = [f64; 3]>) {
        self.places.extend(fresh.step_by(1 << self.halvings));
        while self.places.len() > MAX_ELEVATIONS {
            let every_other = self.places.iter().copied().skip(1).step_by(2).collect();
            self.places = every_other;
            self.halvings += 1;
        }
    }
}

/// The mask at the middles of coarse cells, row by row, 1 where it covers.
fn coarse(mask: &ImageMask) -> Value {
    let (width, height) = mask.size();
    let rows = (MASK_COLUMNS * height / width.max(1)).max(1);
    let middle = |cell: usize, cells: usize, length: usize| (2 * cell + 1) * length / (2 * cells);
    let covered = |cell: usize| {
        let x = middle(cell % MASK_COLUMNS, MASK_COLUMNS, width);
        mask.covers(x, middle(cell / MASK_COLUMNS, rows, height))
    };
    let cells: String = (0..rows * MASK_COLUMNS).map(|cell| if covered(cell) { '1' } else { '0' }).collect();
    json!({ "columns": MASK_COLUMNS, "rows": rows, "cells": cells })
}

/// Shows path, mosaic and map as they were written. What cannot be read stays as it was during the
/// run.
pub fn show_results(hub: &Hub, ground: &LiveGround, folder: &Path) {
    if ground.is_shown()
        && let Ok(Some(picture)) = GroundPicture::of_run(folder, MAX_SHOWN_PIXELS)
    {
        ground.show_written(picture);
    }
    let table = fs::read_to_string(folder.join("trajectory.csv"));
    let records = table.ok().and_then(|table| TrackRecord::from_csv(&table).ok());
    let Some(records) = records else { return };
    hub.replace_records(&records);
    show_map_of_run(hub, folder);
}

/// Shows keyframes, loop closures and markers of the map in the folder of a run, where it has one
/// that can be read. The records must be in the map frame.
pub fn show_map_of_run(hub: &Hub, folder: &Path) {
    let Ok(file) = MapFile::open_read_only(&folder.join("map.gpkg")) else { return };
    if let Ok(map) = file.map() {
        let mut graph = map_graph(&map);
        graph["corrections"] = json!([]);
        hub.notify("map", &graph);
    }
    if let Ok(landmarks) = file.landmarks()
        && !landmarks.is_empty()
    {
        hub.notify("markers", &map_markers(landmarks.into_iter().map(|at| (at.number, at.pose))));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elevations_are_a_bounded_sample_of_the_whole_path() {
        let mut elevations = Elevations::default();
        for keyframe in 0..200 {
            elevations.add((0..150).map(|corner| [f64::from(keyframe), f64::from(corner), 0.01]));
            assert!(elevations.places.len() <= MAX_ELEVATIONS);
        }
        // 30,000 places, of which each eighth is kept.
        assert_eq!(elevations.halvings, 3);
        let mut of_keyframe = [0; 200];
        elevations.places.iter().for_each(|[keyframe, ..]| of_keyframe[*keyframe as usize] += 1);
        assert!(of_keyframe.iter().all(|count| (15..=22).contains(count)), "{of_keyframe:?}");
    }
}
