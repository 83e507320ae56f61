//! Markers on the ground during a run: found in keyframes, and the map in their survey frame.

use crate::files;
use crate::plan::RunPlan;
use crate::timings::Timings;
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::formats::control_file;
use odograph::landmark::{ControlPoint, MarkerSighting, PlacedSighting};
use odograph::odometry::NewKeyframe;
use odograph::pose_graph::Unplaceable;
use odograph::slam::{Mapper, Surveyed};
use odograph_calibration::{MarkerFamily, MarkerFinder};
use odograph_map::{MapFile, MapMarker};
use std::path::PathBuf;
use std::time::Instant;

/// Largest size of a control file, bytes: a hundred thousand markers.
const MAX_BYTES: u64 = 4 << 20;

/// Largest relative difference of a marker's measured side from the stated one. Larger admits a
/// height that is further off, smaller rejects more squares that are no markers.
const MAX_OFF: f64 = 0.25;

/// Side in the image of the smallest marker that is looked for, as a share of that directly below
/// the camera. Smaller finds markers farther away in a tilted view, larger takes less time.
const MIN_SHARE: f64 = 0.4;

/// Largest relative difference of the sides that two sessions state for the same markers: of
/// rounding. Markers of another size are others.
const SAME_SIDE: f64 = 1e-3;

/// Looks for markers in keyframes.
pub struct MarkerWatch {
    pub family: MarkerFamily,
    finder: MarkerFinder,
    camera: Camera,
    /// The control points and their file.
    pub control: Option<(PathBuf, Vec<ControlPoint>)>,
    pub times: Timings,
    /// Sides of squares that read as markers but are of another size, metres.
    pub other_sides_m: Vec<f64>,
    /// The map in the survey frame, or why it is not; `None` before the end and without control
    /// points.
    pub surveyed: Option<std::result::Result<Surveyed, Unplaceable>>,
}

impl MarkerWatch {
    /// Reads what the plan says; `None` where no markers are looked for. `camera` is that of the
    /// keyframes.
    ///
    /// # Errors
    /// If the family is unknown, or the control points cannot be read or are not of the family.
    pub fn new(plan: &RunPlan, camera: &Camera) -> Result<Option<Self>> {
        let Some(markers) = &plan.markers else { return Ok(None) };
        let family: MarkerFamily = markers.family.parse()?;
        let control = match &markers.control {
            Some(path) => {
                let text = files::read_text_within(path, MAX_BYTES)?;
                let points = control_file::parse(&text).map_err(|error| error.at(path.display()))?;
                if let Some(unknown) = points.iter().find(|point| point.number as usize >= family.markers()) {
                    return Err(Error::input(format!(
                        "{}: there is no marker {} in the family {family}, whose numbers are 0 to {}",
                        path.display(),
                        unknown.number,
                        family.markers() - 1
                    )));
                }
                Some((path.clone(), points))
            }
            None => None,
        };
        Ok(Some(Self {
            family,
            finder: MarkerFinder::new(&family),
            camera: camera.clone(),
            control,
            times: Timings::default(),
            other_sides_m: Vec::new(),
            surveyed: None,
        }))
    }

    /// The markers of the family that earlier sessions of a map have seen.
    ///
    /// # Errors
    /// If they cannot be read.
    pub fn seen_before(&self, map: &MapFile) -> Result<Vec<PlacedSighting>> {
        let (name, side_m) = (self.family.name(), self.family.side_m());
        let same =
            |marker: &MapMarker| marker.family == name && (marker.size_m / side_m - 1.0).abs() <= SAME_SIDE;
        let seen = map.markers()?.into_iter().filter(same);
        Ok(seen.map(|marker| marker.placed).collect())
    }

    /// The markers that a new keyframe shows.
    pub fn look(&mut self, new: &NewKeyframe) -> Vec<MarkerSighting> {
        let started = Instant::now();
        let mut sightings = Vec::new();
        let (fx, fy) = self.camera.focal_px();
        let usual_px = self.family.side_m() * fx.min(fy) / new.pose.height_m;
        for seen in self.finder.find(&new.image, MIN_SHARE * usual_px) {
            let sighting = MarkerSighting::new(
                seen.number as u32,
                new.id,
                &seen.corners,
                &self.camera,
                &new.pose,
                &new.covariance,
            );
            let Some(sighting) = sighting else { continue };
            if (sighting.side_m / self.family.side_m() - 1.0).abs() <= MAX_OFF {
                sightings.push(sighting);
            } else {
                self.other_sides_m.push(sighting.side_m);
            }
        }
        self.times.push(started.elapsed());
        sightings
    }

    /// Places the finished map in the survey frame, where there are control points.
    pub fn survey(&mut self, mapper: &mut Mapper) {
        self.surveyed = self.control.as_ref().map(|(_, points)| mapper.survey(points));
    }
}
