//! Markers of a run, for `stats.json` and for people.

use crate::markers::MarkerWatch;
use crate::timings::StageTime;
use odograph::drawing::DrawnLandmark;
use odograph::geometry::GroundPoint;
use odograph::numerics::median;
use odograph::slam::{Landmark, Mapper};
use serde::Serialize;
use std::collections::BTreeMap;

/// Markers that a run has seen, as in `stats.json`.
#[derive(Debug, Clone, Serialize)]
pub struct MarkerStatistics {
    /// Family and stated side.
    pub family: String,
    /// Number of sightings in keyframes.
    pub sightings: usize,
    /// Loop edges between keyframes that show the same marker.
    pub ties: usize,
    /// Median side as seen in the final map over the stated one; `null` without markers.
    pub side_ratio: Option<f64>,
    /// Time for finding markers, per keyframe.
    pub find: StageTime,
    /// Whether the map is in the frame of the control points.
    pub surveyed: bool,
    /// The reason if there are control points and it is not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Length in the survey frame of a metre as odometry measured it; 1 where the control points
    /// show no other.
    pub scale: f64,
    /// Its standard deviation; 0 where it is 1.
    pub sigma_scale: f64,
    /// The markers, in order of their numbers.
    pub landmarks: Vec<LandmarkStatistics>,
    /// Control points of markers that were not seen.
    pub control_not_seen: usize,
}

/// A marker in the map.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LandmarkStatistics {
    /// Its number.
    pub marker: u32,
    /// x of its centre in the map, metres.
    pub x_m: f64,
    /// y of its centre, metres.
    pub y_m: f64,
    /// Direction of its top as printed, counter-clockwise from x, degrees.
    pub heading_deg: f64,
    /// Root mean square distance of its sightings from there, metres.
    pub spread_m: f64,
    /// Number of keyframes that show it.
    pub sightings: usize,
    /// Number of separate visits of the camera.
    pub visits: usize,
    /// Whether another place has the same number and more sightings.
    pub double: bool,
    /// Distance from its control point, metres; left out if it has none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub control_off_m: Option<f64>,
    /// Whether most of its sightings contradict its control point, which was left out.
    pub rejected: bool,
}

/// Relative difference of a marker's measured side from the stated one above which a warning is
/// given. A printer is exact to 1 %.
const SIDE_OFF: f64 = 0.03;

impl LandmarkStatistics {
    fn of(landmark: &Landmark) -> Self {
        Self {
            marker: landmark.number,
            x_m: landmark.pose.x_m,
            y_m: landmark.pose.y_m,
            heading_deg: landmark.pose.heading_rad.to_degrees(),
            spread_m: landmark.spread_m,
            sightings: landmark.sightings,
            visits: landmark.visits,
            double: landmark.is_double,
            control_off_m: landmark.control.map(|of| of.off_m),
            rejected: landmark.control.is_some_and(|of| 2 * of.used < landmark.sightings),
        }
    }
}

impl MarkerStatistics {
    pub(crate) fn of(watch: &MarkerWatch, mapper: &Mapper) -> Self {
        let surveyed = watch.surveyed.as_ref().and_then(|of| of.as_ref().ok());
        let landmarks = mapper.landmarks(surveyed);
        let scale = surveyed.map_or(1.0, |of| of.survey_from_map.scale);
        let mut ratios: Vec<f64> =
            landmarks.iter().map(|landmark| scale * landmark.side_m / watch.family.side_m()).collect();
        let control = watch.control.iter().flat_map(|(_, points)| points);
        let seen = |number: u32| landmarks.iter().any(|landmark| landmark.number == number);
        Self {
            family: watch.family.to_string(),
            sightings: mapper.marker_sightings(),
            ties: mapper.marker_edges(),
            side_ratio: median(&mut ratios),
            find: StageTime::of(&watch.times),
            surveyed: surveyed.is_some(),
            reason: watch.surveyed.as_ref().and_then(|of| of.as_ref().err()).map(ToString::to_string),
            scale,
            sigma_scale: surveyed.map_or(0.0, |of| of.scale_sigma),
            control_not_seen: control.filter(|point| !seen(point.number)).count(),
            landmarks: landmarks.iter().map(LandmarkStatistics::of).collect(),
        }
    }

    /// Sentences for people; the camera was taken to be this high.
    pub(crate) fn warnings(&self, watch: &MarkerWatch, height_m: f64) -> Vec<String> {
        let mut sentences = Vec::new();
        let control = watch.control.as_ref().map_or_else(String::new, |(path, _)| path.display().to_string());
        if self.landmarks.is_empty() {
            let other = median(&mut watch.other_sides_m.clone());
            let why = other.map_or_else(
                || "check the family, and that a white margin of a bit is around them".to_owned(),
                |side_m| format!("what reads like them has sides of about {:.0} mm", 1e3 * side_m),
            );
            sentences.push(format!("no marker {} was seen: {why}", self.family));
        }
        if let Some(reason) = &self.reason {
            sentences.push(format!("the map is not in the frame of {control}: {reason}"));
        }
        for landmark in self.landmarks.iter().filter(|landmark| landmark.rejected) {
            sentences.push(format!(
                "marker {} contradicts {control}: it is {:.3} m from where that has it, and this control point is left \
                 out; check whether it was moved or its line is wrong",
                landmark.marker,
                landmark.control_off_m.unwrap_or(0.0)
            ));
        }
        let mut places: BTreeMap<u32, Vec<&LandmarkStatistics>> = BTreeMap::new();
        for landmark in &self.landmarks {
            places.entry(landmark.marker).or_default().push(landmark);
        }
        for (marker, of) in places.iter().filter(|(_, of)| of.len() > 1) {
            let apart_m = (of[0].x_m - of[1].x_m).hypot(of[0].y_m - of[1].y_m);
            sentences.push(format!(
                "marker {marker} was seen at {} places, {apart_m:.2} m apart: there are two with this number, or it was \
                 moved; its places are not tied together",
                of.len()
            ));
        }
        if self.scale != 1.0 {
            sentences.push(format!(
                "by {control} a metre of the path is {:.5} ± {:.5} m: the camera is probably {:.4} m high; path and map \
                 are corrected",
                self.scale,
                self.sigma_scale,
                height_m * self.scale
            ));
        }
        if let Some(ratio) = self.side_ratio.filter(|ratio| (ratio - 1.0).abs() > SIDE_OFF) {
            sentences.push(format!(
                "markers appear with a side of {:.1} mm instead of {:.1} mm: measure one; if the stated side is right, the \
                 camera's height is not",
                1e3 * ratio * watch.family.side_m(),
                1e3 * watch.family.side_m()
            ));
        }
        sentences
    }

    /// The markers for a drawing.
    pub(crate) fn drawn(&self) -> Vec<DrawnLandmark> {
        let drawn = |landmark: &LandmarkStatistics| DrawnLandmark {
            number: landmark.marker,
            at: GroundPoint::new(landmark.x_m, landmark.y_m),
            doubtful: landmark.rejected || landmark.double,
        };
        self.landmarks.iter().map(drawn).collect()
    }

    /// One line; empty without markers.
    pub fn summary(&self) -> String {
        if self.landmarks.is_empty() {
            return String::new();
        }
        let (control, rejected) = (
            self.landmarks.iter().filter(|landmark| landmark.control_off_m.is_some()).count(),
            self.landmarks.iter().filter(|landmark| landmark.rejected).count(),
        );
        let survey = match self.surveyed {
            true => {
                format!("; the map is in the frame of {} of {control} control points", control - rejected)
            }
            false => String::new(),
        };
        format!("{} markers seen {} times{survey}\n", self.landmarks.len(), self.sightings)
    }
}
