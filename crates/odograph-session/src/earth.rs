//! Where on Earth a run was, by a satellite receiver (GNSS): the fixes, the antenna's path, and the
//! files with positions on Earth.

use crate::earth_statistics::GnssStatistics;
use crate::files;
use crate::folder::OutputFolder;
use crate::kept_frames::KeptFrames;
use crate::plan::RunPlan;
use crate::sensors::SensorFiles;
use nalgebra::{Matrix2, Point3, Rotation2, Vector2};
use odograph::camera::LeverArm;
use odograph::error::{Error, Result};
use odograph::formats::decimal::Rounded;
use odograph::formats::geojson::{self, Feature};
use odograph::formats::gnss_file;
use odograph::geometry::EarthPosition;
use odograph::georeference::{AntennaPosition, FixUse, Georeference, GnssFix, georeference};
use odograph::keyframe::KeyframeId;
use odograph::pose_frame::PoseFrames;
use odograph::slam::{AntennaFix, DriftCorrection};
use odograph::trajectory::{FrameEstimate, FrameSummary, PlaceSummary};
use std::fmt::Write;

/// The path on Earth as GeoJSON, its frames with UTM coordinates, and the mosaic in UTM.
pub const GEOJSON: &str = "trajectory.geojson";
pub const UTM_TABLE: &str = "trajectory-utm.csv";
pub const UTM_MOSAIC: &str = "mosaic-utm.tif";

/// The positions that a receiver sent during a live run, which are nowhere else.
pub const RECEIVED_FIXES: &str = "gnss-received.csv";

/// The rig file with what was found of the antenna, and of the camera by a wheel.
pub const FOUND_RIG: &str = "rig-found.toml";

/// Largest size of a file of fixes, bytes: weeks of NMEA at ten a second.
const MAX_BYTES: u64 = 256 << 20;

/// Standard deviation of a receiver's time minus the camera's, seconds: of clocks that are
/// synchronised or of one recorder, and of a start that a person stated or of the delay with which
/// positions arrive.
const SYNCHRONISED_S: f64 = 0.2;
const STATED_S: f64 = 1.0;

/// Where the antenna is on the robot.
#[derive(Debug, Clone, Copy, Default)]
pub struct Antenna {
    /// As it is stated, in `base_link`.
    stated: Option<LeverArm>,
    /// As the positions show it, ahead and to the left of the robot or of the camera, metres, with
    /// its standard deviation.
    found_m: Option<(Vector2<f64>, f64)>,
}

impl Antenna {
    /// Where it is stated to be.
    pub fn stated(plan: &RunPlan) -> Self {
        Self { stated: plan.antenna, found_m: None }
    }

    fn is_known(&self) -> bool {
        self.stated.is_some() || self.found_m.is_some()
    }

    /// A warning where it was found.
    fn warning(&self, name: &str) -> Option<String> {
        let (at_m, sigma_m) = self.found_m?;
        let [ahead_m, left_m, sigma_m] = [at_m.x, at_m.y, sigma_m].map(Rounded);
        Some(format!(
            "by {name} the antenna is {ahead_m:.3} m ahead and {left_m:.3} m to the left (± {sigma_m:.3} m) of what moves \
             along the path: that was used, and is in {FOUND_RIG}, to be given as --rig"
        ))
    }

    /// Where it was found, ahead and to the left of the robot or of the camera, metres, with its
    /// standard deviation.
    pub fn found_m(&self) -> Option<(Vector2<f64>, f64)> {
        self.found_m
    }

    /// Where it is stated to be.
    pub fn stated_at(&self) -> Option<LeverArm> {
        self.stated
    }
}

/// Fixes of a run.
pub struct GnssRecord {
    /// The file or topic.
    name: String,
    fixes: Vec<GnssFix>,
    clock_sigma_s: f64,
    /// Whether they came during the run.
    is_received: bool,
}

impl GnssRecord {
    /// Reads the file, or the topic of the recording; `None` if neither is given. What is wrong
    /// with the topic is added to the warnings.
    pub fn read(sensors: &SensorFiles, recording: &str, warnings: &mut Vec<String>) -> Result<Option<Self>> {
        let start_s = sensors.gnss_start.as_deref().map(start_s).transpose()?;
        let (name, mut fixes) = match (&sensors.gnss, &sensors.gnss_topic) {
            (Some(path), _) if path.is_dir() => {
                let (fixes, found) = odograph_video::picture_fixes(path)?;
                warnings.extend(found);
                (path.display().to_string(), fixes)
            }
            (Some(path), _) => {
                let text = files::read_text_within(path, MAX_BYTES)?;
                let fixes = gnss_file::parse(&text).map_err(|error| error.at(path.display()))?;
                (path.display().to_string(), fixes)
            }
            (None, Some(topic)) => {
                let (fixes, found) = odograph_video::recorded_fixes(recording, topic)?;
                warnings.extend(found);
                (topic.clone(), fixes)
            }
            (None, None) if start_s.is_some() => {
                return Err(Error::usage(
                    "a start for a satellite receiver needs its positions: --gnss FILE",
                ));
            }
            (None, None) => return Ok(None),
        };
        fixes.iter_mut().for_each(|fix| fix.time_s -= start_s.unwrap_or(0.0));
        let clock_sigma_s = if start_s.is_some() { STATED_S } else { SYNCHRONISED_S };
        Ok(Some(Self { name, fixes, clock_sigma_s, is_received: false }))
    }

    /// Positions that a receiver has sent during the run, by the clock of the frames.
    #[cfg_attr(not(feature = "live"), allow(dead_code))]
    pub fn received(name: String, fixes: Vec<GnssFix>) -> Self {
        Self { name, fixes, clock_sigma_s: STATED_S, is_received: true }
    }

    /// The positions that were received during the run, as CSV that a later run reads; `None` if
    /// there are no such positions.
    pub fn received_csv(&self) -> Option<String> {
        (self.is_received && !self.fixes.is_empty()).then(|| gnss_file::write(&self.fixes))
    }

    /// The times of the first and the last fix, seconds of the recording.
    fn span_s(&self) -> Option<(f64, f64)> {
        Some((self.fixes.first()?.time_s, self.fixes.last()?.time_s))
    }

    /// Seeks the antenna where it is not stated, from its path as if it were at the camera.
    pub fn locate(&self, antenna: Antenna, path: &[AntennaPosition]) -> Antenna {
        if antenna.is_known() {
            return antenna;
        }
        let found = georeference(path, &self.fixes, self.clock_sigma_s, false).ok();
        Antenna { found_m: found.and_then(|found| found.antenna_m), ..antenna }
    }

    /// The fixes with their points of the path, and its georeference before any correction; `None`
    /// if it has none.
    /// `path` is in the map frame, `measured` as [`measured_path`] has it.
    pub fn antenna_fixes(
        &self,
        path: &[AntennaPosition],
        measured: &[(AntennaPosition, KeyframeId)],
    ) -> Option<(Vec<AntennaFix>, Georeference)> {
        let found = georeference(path, &self.fixes, self.clock_sigma_s, true).ok()?;
        let on_path = |fix: &GnssFix| {
            let time_s = fix.time_s - found.clock_offset_s;
            let next = measured.partition_point(|(at, _)| at.time_s <= time_s);
            let (before, keyframe) = measured.get(next.checked_sub(1)?)?;
            let (after, _) = measured.get(next)?;
            let step_s = after.time_s - before.time_s;
            if before.segment != after.segment || step_s <= 0.0 || step_s > AntennaPosition::LONGEST_STEP_S {
                return None;
            }
            let share = (time_s - before.time_s) / step_s;
            Some(AntennaFix {
                keyframe: *keyframe,
                position_m: before.position_m.lerp(&after.position_m, share),
                covariance_m2: before.covariance_m2,
                place_m: found.anchor.in_plane_m(fix.place),
                place_covariance_m2: fix.covariance_m2,
            })
        };
        Some((self.fixes.iter().filter_map(on_path).collect(), found))
    }

    /// Places a run on Earth; `bent` is the correction of the map by the positions.
    pub fn place(
        &self,
        plan: &RunPlan,
        antenna: &Antenna,
        path: &[AntennaPosition],
        frames: &[FrameSummary],
        bent: Option<DriftCorrection>,
    ) -> OnEarth {
        let span_s = frames.first().zip(frames.last()).map(|(first, last)| (first.time_s, last.time_s));
        let apart = self.span_s().zip(span_s).filter(|(own, run)| own.0 > run.1 || own.1 < run.0);
        let reason = match (apart, georeference(path, &self.fixes, self.clock_sigma_s, true)) {
            (Some((own, run)), _) => {
                let hint = if plan.sensors.gnss_start.is_some() {
                    "check --gnss-start"
                } else {
                    "--gnss-start gives the time (UTC) at which the recording's time is 0"
                };
                format!(
                    "its positions are of {:.1} to {:.1} s and the frames of {:.1} to {:.1} s; {hint}",
                    own.0, own.1, run.0, run.1
                )
            }
            (None, Err(reason)) => reason.to_string(),
            (None, Ok(found)) => {
                let statistics = GnssStatistics::of(&self.fixes, &found, antenna.found_m, bent);
                let mut warnings = statistics.warnings(&self.name, plan.rig.height_m);
                warnings.extend(antenna.warning(&self.name));
                warnings.extend(self.clock_warning(path, &found));
                return OnEarth { statistics, warnings, place: Some(found) };
            }
        };
        let warnings = vec![format!("the positions of {} are not used: {reason}", self.name)];
        let statistics =
            GnssStatistics { fixes: self.fixes.len(), reason: Some(reason), ..GnssStatistics::default() };
        OnEarth { statistics, warnings, place: None }
    }
}

/// Magnitude of an estimated clock offset above which the receiver's times are doubted, seconds:
/// five times what synchronised clocks may differ by, and all that a stated start may be off by.
const DOUBTED_OFFSET_S: f64 = 1.0;

/// Fraction of the positions with a path at their times that may be unused; of more, the times are
/// doubted.
const DOUBTED_UNUSED: f64 = 0.2;

impl GnssRecord {
    /// A warning where the times are probably of another clock: over a regular path, positions at
    /// wrong times agree with a wrong place and direction, and nothing else shows it.
    fn clock_warning(&self, path: &[AntennaPosition], found: &Georeference) -> Option<String> {
        let has_path = |fix: &GnssFix| {
            let next = path.partition_point(|at| at.time_s <= fix.time_s);
            let around = next.checked_sub(1).and_then(|before| path.get(before)).zip(path.get(next));
            around.is_some_and(|(before, after)| {
                let step_s = after.time_s - before.time_s;
                before.segment == after.segment && step_s <= AntennaPosition::LONGEST_STEP_S
            })
        };
        let fixes = || self.fixes.iter().zip(&found.fixes).filter(|(fix, _)| has_path(fix));
        let within = fixes().count();
        let unused = fixes().filter(|(_, of)| !matches!(of, FixUse::Used(_))).count();
        let offset_s = found.clock_offset_s;
        let is_far = offset_s.abs() > DOUBTED_OFFSET_S;
        let lacks = unused as f64 > DOUBTED_UNUSED * within as f64;
        let way = if offset_s < 0.0 { "behind" } else { "ahead of" };
        let clock = format!("its clock was found to be {:.2} s {way} the recording's", offset_s.abs());
        let share = format!("{unused} of its {within} positions along the path are not used");
        let shown = match (is_far, lacks) {
            (false, false) => return None,
            (true, false) => clock,
            (false, true) => share,
            (true, true) => format!("{clock}, and {share}"),
        };
        Some(format!(
            "the times of {} may not be those of the recording: {shown}; place and bearing may be wrong by far more than their \
             standard deviations; compare the times of both, and give --gnss-start to a second where they count from another \
             moment",
            self.name
        ))
    }
}

/// The time of a recording's 0, seconds since 1970.
fn start_s(text: &str) -> Result<f64> {
    gnss_file::parse_utc(text).ok_or_else(|| {
        Error::usage(format!(
            "{text:?} is no time; give the UTC at which the recording's time was 0 as 2026-05-04T10:12:33.5Z"
        ))
    })
}

/// The path of the antenna, from the frames of the camera's path; where it is not known, that of
/// `base_link`, or of the camera.
pub fn antenna_path(
    frames: &mut KeptFrames,
    of: &PoseFrames,
    antenna: &Antenna,
) -> Result<Vec<AntennaPosition>> {
    let mut path: Vec<AntennaPosition> = Vec::with_capacity(frames.posed());
    let mut follows = false;
    frames.each(|frame, _| {
        let at = antenna_position(frame, of, antenna);
        if let (Some(before), Some(at), true) = (path.last().copied(), at, follows) {
            path.extend(between(&before, &at));
        }
        path.extend(at);
        follows = at.is_some();
        Ok(())
    })?;
    Ok(path)
}

/// Positions between those of two frames that follow each other, where these are farther apart than
/// a path is interpolated, as pictures that are taken one by one are.
fn between(before: &AntennaPosition, after: &AntennaPosition) -> Vec<AntennaPosition> {
    let steps = ((after.time_s - before.time_s) / AntennaPosition::LONGEST_STEP_S).ceil();
    if before.segment != after.segment || !(2.0..=LONGEST_STEPS).contains(&steps) {
        return Vec::new();
    }
    let at = |share: f64| AntennaPosition {
        time_s: before.time_s + share * (after.time_s - before.time_s),
        position_m: before.position_m.lerp(&after.position_m, share),
        heading_rad: before.heading_rad + share * (after.heading_rad - before.heading_rad),
        ..*after
    };
    (1..steps as u32).map(|step| at(f64::from(step) / steps)).collect()
}

/// Number of steps between frames above which the positions between them say nothing.
const LONGEST_STEPS: f64 = 10.0;

/// The path of the antenna in the odometry frame, each position with the keyframe that its frame
/// was measured against and its covariance from there.
pub fn measured_path(
    frames: &mut KeptFrames,
    of: &PoseFrames,
    antenna: &Antenna,
) -> Result<Vec<(AntennaPosition, KeyframeId)>> {
    let mut path: Vec<(AntennaPosition, KeyframeId)> = Vec::with_capacity(frames.posed());
    let mut follows = false;
    frames.each(|frame, reference| {
        let known = frame.estimate.as_ref().zip(reference).zip(antenna_position(frame, of, antenna));
        let at = known.map(|((known, reference), at)| {
            let own = known.measured.covariance.fixed_view::<2, 2>(0, 0).into_owned();
            (AntennaPosition { covariance_m2: own, ..at }, reference.keyframe)
        });
        if let (Some(before), Some((at, keyframe)), true) = (path.last().copied(), at, follows) {
            path.extend(between(&before.0, &at).into_iter().map(|between| (between, keyframe)));
        }
        path.extend(at);
        follows = at.is_some();
        Ok(())
    })?;
    Ok(path)
}

/// Where the antenna was at a frame.
fn antenna_position(frame: &FrameEstimate, of: &PoseFrames, antenna: &Antenna) -> Option<AntennaPosition> {
    let arm = antenna.stated.map_or_else(Point3::origin, |arm| Point3::new(arm.x_m, arm.y_m, arm.z_m));
    let own = of.at(frame.frame);
    let seen = own.frame(frame);
    let known = seen.estimate.as_ref()?;
    let there = own.world_from_frame(&known.pose) * arm;
    let heading_rad = known.pose.heading_rad;
    let beside_m =
        antenna.found_m.map_or_else(Vector2::zeros, |(at_m, _)| Rotation2::new(heading_rad) * at_m);
    Some(AntennaPosition {
        time_s: frame.time_s,
        position_m: Vector2::new(there.x, there.y) + beside_m,
        heading_rad,
        covariance_m2: known.covariance.fixed_view::<2, 2>(0, 0).into_owned(),
        segment: frame.segment,
    })
}

/// Result of the satellite receiver.
pub struct OnEarth {
    pub statistics: GnssStatistics,
    pub warnings: Vec<String>,
    /// `None` if the run has no place on Earth.
    pub place: Option<Georeference>,
}

/// Writes the path on Earth, or removes that of an earlier run.
pub fn write(folder: &mut OutputFolder, place: Option<&Georeference>, frames: &[FrameSummary]) -> Result<()> {
    let Some(found) = place else {
        return [GEOJSON, UTM_TABLE, UTM_MOSAIC].iter().try_for_each(|name| folder.remove(name));
    };
    folder.write(GEOJSON, geojson::write(&stretches(found, frames)).as_bytes())?;
    folder.write_lines(UTM_TABLE, UTM_HEADER, |put| {
        let placed = frames.iter().filter_map(|frame| Some((frame, frame.place?)));
        placed.into_iter().try_for_each(|(frame, place)| put(&utm_line(found, frame, &place)))
    })
}

fn stretches(found: &Georeference, frames: &[FrameSummary]) -> Vec<Feature> {
    let placed: Vec<(&FrameSummary, PlaceSummary)> =
        frames.iter().filter_map(|frame| Some((frame, frame.place?))).collect();
    let connected = placed.chunk_by(|(a, _), (b, _)| a.segment == b.segment);
    connected
        .filter(|stretch| stretch.len() > 1)
        .map(|stretch| {
            let (first, last) = (stretch[0].0, stretch[stretch.len() - 1].0);
            let place = |(_, place): &(&FrameSummary, PlaceSummary)| -> EarthPosition {
                found.anchor.place(place.x_m, place.y_m)
            };
            Feature {
                properties: vec![
                    ("segment", first.segment.to_string()),
                    ("start_s", format!("{:?}", first.time_s)),
                    ("end_s", format!("{:?}", last.time_s)),
                ],
                places: stretch.iter().map(place).collect(),
            }
        })
        .collect()
}

const UTM_HEADER: &str = "frame,time_s,latitude_deg,longitude_deg,easting_m,northing_m,epsg,bearing_deg,sigma_east_m,sigma_north_m,\
                          sigma_bearing_deg\n";

fn utm_line(found: &Georeference, frame: &FrameSummary, place: &PlaceSummary) -> String {
    let (longitude, latitude) = geojson::degrees(&found.anchor.place(place.x_m, place.y_m));
    let (easting_m, northing_m) = found.anchor.utm(place.x_m, place.y_m);
    let [xx, xy, yy] = place.position_covariance;
    let covariance = found.covariance_m2(Vector2::new(place.x_m, place.y_m), &Matrix2::new(xx, xy, xy, yy));
    let bearing_sigma_rad = (place.heading_variance + found.heading_sigma_rad.powi(2)).max(0.0).sqrt();
    let mut line =
        format!("{},{:.6},{latitude},{longitude},{easting_m:.4},{northing_m:.4},", frame.frame, frame.time_s);
    let _ = writeln!(
        line,
        "{},{:.5},{:.4},{:.4},{:.5}",
        found.anchor.utm_code(),
        found.anchor.bearing_rad(place.heading_rad).to_degrees(),
        covariance[(0, 0)].max(0.0).sqrt(),
        covariance[(1, 1)].max(0.0).sqrt(),
        bearing_sigma_rad.to_degrees()
    );
    line
}

#[cfg(test)]
mod tests {
    use super::*;
    use odograph::geometry::TangentPlane;

    /// A drive in bends, 40 s at about 1 m/s.
    fn way(time_s: f64) -> Vector2<f64> {
        Vector2::new(0.9 * time_s + (0.5 * time_s).sin(), 4.0 * (0.31 * time_s).sin())
    }

    /// The path, and a receiver whose clock is ahead by this.
    fn recorded(clock_s: f64) -> (Vec<AntennaPosition>, GnssRecord) {
        let path = (0..=800).map(|k| f64::from(k) / 20.0).map(|time_s| AntennaPosition {
            time_s,
            position_m: way(time_s),
            heading_rad: 0.0,
            covariance_m2: Matrix2::identity() * 1e-6,
            segment: 0,
        });
        let reference = EarthPosition::from_degrees(48.2, 16.4).unwrap();
        let plane = TangentPlane { reference, altitude_m: 180.0 };
        let fixes = (0..=40).map(f64::from).map(|time_s| {
            let at = way(time_s);
            GnssFix {
                time_s: time_s + clock_s,
                place: plane.place([at.x, at.y]),
                altitude_m: Some(180.0),
                covariance_m2: GnssFix::covariance_m2(0.02, 0.02),
            }
        });
        let record = GnssRecord {
            name: "log.csv".to_owned(),
            fixes: fixes.collect(),
            clock_sigma_s: STATED_S,
            is_received: false,
        };
        (path.collect(), record)
    }

    #[test]
    fn a_clock_that_is_far_off_is_doubted() {
        let warning = |clock_s: f64, unused: usize| {
            let (path, record) = recorded(clock_s);
            let mut found = georeference(&path, &record.fixes, record.clock_sigma_s, true).unwrap();
            assert!((found.clock_offset_s - clock_s).abs() < 0.1, "{}", found.clock_offset_s);
            found.fixes[10..10 + unused].fill(FixUse::Rejected(3.0));
            record.clock_warning(&path, &found)
        };
        assert_eq!(warning(0.1, 0), None);
        assert_eq!(warning(0.1, 6), None);
        let far = warning(-1.7, 0).unwrap();
        assert!(far.contains("log.csv") && far.contains("its clock was found to be 1.70 s behind"), "{far}");
        let unused = warning(0.1, 12).unwrap();
        assert!(unused.contains("of its 40 positions along the path are not used"), "{unused}");
        assert!(!unused.contains("its clock"), "{unused}");
    }
}
