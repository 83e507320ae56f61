//! Where on Earth a run was, for `stats.json` and for people.

use nalgebra::Vector2;
use odograph::georeference::{FixUse, Georeference, GnssFix};
use odograph::slam::DriftCorrection;
use serde::Serialize;

/// Result of the satellite receiver, as in `stats.json`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct GnssStatistics {
    /// Number of positions.
    pub fixes: usize,
    /// How many were used.
    pub used: usize,
    /// How many contradict the others.
    pub rejected: usize,
    /// The reason if the run has no place on Earth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Where the run was.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub place: Option<EarthStatistics>,
}

/// Where a run was on Earth.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EarthStatistics {
    /// Latitude of the world's origin, degrees.
    pub latitude_deg: f64,
    /// Longitude of the world's origin, degrees.
    pub longitude_deg: f64,
    /// Compass heading of the world's x, degrees.
    pub bearing_deg: f64,
    /// EPSG's number of the UTM zone.
    pub epsg: u16,
    /// Standard deviation of the rotation, degrees.
    pub sigma_bearing_deg: f64,
    /// Standard deviation of the shift to the east, at the middle of the path, metres.
    pub sigma_east_m: f64,
    /// Standard deviation of the shift to the north, at the middle of the path, metres.
    pub sigma_north_m: f64,
    /// Root mean square distance of the used positions from the path, metres.
    pub rmse_m: f64,
    /// Length on Earth of a metre as odometry measured it; 1 unless the positions show another.
    pub scale: f64,
    /// Its standard deviation; 0 where it was not estimated.
    pub sigma_scale: f64,
    /// Whether the positions showed that the path has drifted or is of another scale, and path and
    /// map are corrected.
    pub bent: bool,
    /// The antenna ahead of the robot or the camera, metres, where it was not stated and the
    /// positions show it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub antenna_ahead_m: Option<f64>,
    /// The same to the left.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub antenna_left_m: Option<f64>,
    /// Its standard deviation, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sigma_antenna_m: Option<f64>,
    /// The receiver's time minus the camera's, seconds.
    pub clock_offset_s: f64,
    /// Its standard deviation, seconds.
    pub sigma_clock_offset_s: f64,
    /// The positions that contradict the others, the first of them.
    pub outliers: Vec<GnssOutlier>,
}

/// A position that contradicts the others.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct GnssOutlier {
    /// Its time, seconds of the recording.
    pub time_s: f64,
    /// Its distance from the path, metres.
    pub off_m: f64,
}

/// Number of outliers listed in `stats.json`; all are counted.
const MAX_OUTLIERS: usize = 100;

impl GnssStatistics {
    pub(crate) fn of(
        fixes: &[GnssFix],
        found: &Georeference,
        antenna_m: Option<(Vector2<f64>, f64)>,
        bent: Option<DriftCorrection>,
    ) -> Self {
        // The path already has the metres that the map was bent to.
        let (scale, scale_sigma) = match bent {
            Some(bent) => (bent.scale * found.scale, bent.scale_sigma.hypot(found.scale_sigma)),
            None => (found.scale, found.scale_sigma),
        };
        let outliers: Vec<GnssOutlier> = fixes
            .iter()
            .zip(&found.fixes)
            .filter_map(|(fix, of)| match of {
                FixUse::Rejected(off_m) => {
                    Some(GnssOutlier { time_s: fix.time_s - found.clock_offset_s, off_m: *off_m })
                }
                _ => None,
            })
            .collect();
        let origin = found.anchor.place(0.0, 0.0);
        Self {
            fixes: fixes.len(),
            used: found.used(),
            rejected: outliers.len(),
            reason: None,
            place: Some(EarthStatistics {
                latitude_deg: origin.latitude_rad.to_degrees(),
                longitude_deg: origin.longitude_rad.to_degrees(),
                bearing_deg: found.anchor.bearing_rad(0.0).to_degrees(),
                epsg: found.anchor.utm_code(),
                sigma_bearing_deg: found.heading_sigma_rad.to_degrees(),
                sigma_east_m: found.shift_covariance_m2[(0, 0)].sqrt(),
                sigma_north_m: found.shift_covariance_m2[(1, 1)].sqrt(),
                rmse_m: found.rmse_m,
                scale,
                sigma_scale: scale_sigma,
                bent: bent.is_some(),
                antenna_ahead_m: antenna_m.map(|(at_m, _)| at_m.x),
                antenna_left_m: antenna_m.map(|(at_m, _)| at_m.y),
                sigma_antenna_m: antenna_m.map(|(_, sigma_m)| sigma_m),
                clock_offset_s: found.clock_offset_s,
                sigma_clock_offset_s: found.clock_offset_sigma_s,
                outliers: outliers.into_iter().take(MAX_OUTLIERS).collect(),
            }),
        }
    }

    /// Sentences for people on the record `name` and a camera at this height.
    pub(crate) fn warnings(&self, name: &str, height_m: f64) -> Vec<String> {
        let Some(place) = &self.place else { return Vec::new() };
        let farthest = place.outliers.iter().max_by(|a, b| a.off_m.total_cmp(&b.off_m));
        let outliers = farthest.map(|farthest| {
            format!(
                "{} of {} positions of {name} contradict the path and are left out, such as that of {:.2} s, which is {:.2} m off; \
                 stats.json lists them",
                self.rejected, self.fixes, farthest.time_s, farthest.off_m
            )
        });
        let corrected = match place.bent {
            true => "path and map are corrected",
            false => "positions on Earth have that scale, all else the given one",
        };
        let scale = (place.scale != 1.0).then(|| {
            format!(
                "by {name} a metre of the path is {:.4} ± {:.4} m on Earth: the camera is probably {:.4} m high; {corrected}",
                place.scale,
                place.sigma_scale,
                height_m * place.scale
            )
        });
        outliers.into_iter().chain(scale).collect()
    }

    /// One line; empty without a place on Earth.
    pub fn summary(&self) -> String {
        self.place.as_ref().map_or_else(String::new, |place| {
            format!(
                "on Earth: {:.7}, {:.7}, x towards {:.2}° ± {:.2}°; {} of {} positions used, {:.3} m RMS off\n",
                place.latitude_deg,
                place.longitude_deg,
                place.bearing_deg,
                place.sigma_bearing_deg,
                self.used,
                self.fixes,
                place.rmse_m
            )
        })
    }
}
