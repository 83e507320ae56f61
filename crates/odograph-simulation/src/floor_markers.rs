//! Markers printed on white sheets that lie on the ground.

use odograph::geometry::{GroundPoint, PlaneTransform, Se2};
use odograph_calibration::MarkerFamily;

/// Markers on the ground.
#[derive(Debug, Clone)]
pub(super) struct FloorMarkers {
    family: MarkerFamily,
    /// Each by its number and its pose: x towards its top as printed.
    placed: Vec<(usize, Se2)>,
}

/// Gray levels of paper and ink.
const PAPER: f32 = 225.0;
const INK: f32 = 25.0;
/// Samples along a side of a pixel's footprint.
const SAMPLES: usize = 6;

impl FloorMarkers {
    pub fn new(family: MarkerFamily, placed: Vec<(usize, Se2)>) -> Self {
        Self { family, placed }
    }

    /// Half the diagonal of a sheet, metres.
    fn reach_m(&self) -> f64 {
        std::f64::consts::FRAC_1_SQRT_2 * self.sheet_sides() * self.family.side_m()
    }

    /// Side of a sheet in sides of its marker.
    fn sheet_sides(&self) -> f64 {
        1.0 + 2.0 * MarkerFamily::BORDER_BITS as f64 / self.family.cells() as f64
    }

    /// Those that may reach into a square of this side.
    pub fn near(&self, middle: GroundPoint, side_m: f64) -> Self {
        let reach_m = side_m + self.reach_m();
        let is_near = |pose: &Se2| GroundPoint::new(pose.x_m, pose.y_m).distance(middle) < reach_m;
        Self {
            family: self.family,
            placed: self.placed.iter().filter(|(_, at)| is_near(at)).copied().collect(),
        }
    }

    /// Covers the colour of the ground at a point, averaged over a pixel's footprint.
    pub fn cover(&self, point: GroundPoint, footprint_m: f64, color: &mut [f32; 3]) {
        let reach_m = self.reach_m() + footprint_m;
        for (number, pose) in &self.placed {
            if GroundPoint::new(pose.x_m, pose.y_m).distance(point) > reach_m {
                continue;
            }
            let marker_from_ground = pose.inverse();
            let (mut covered, mut gray) = (0.0f32, 0.0f32);
            for sample in 0..SAMPLES * SAMPLES {
                let off = |at: usize| ((at as f64 + 0.5) / SAMPLES as f64 - 0.5) * footprint_m;
                let at =
                    GroundPoint::new(point.x_m + off(sample % SAMPLES), point.y_m + off(sample / SAMPLES));
                let at = marker_from_ground.apply(at);
                // In sides from the top left corner, to the right and down.
                let (x, y) = (0.5 - at.y_m / self.family.side_m(), 0.5 - at.x_m / self.family.side_m());
                let margin = 0.5 * (self.sheet_sides() - 1.0);
                if (-margin..1.0 + margin).contains(&x) && (-margin..1.0 + margin).contains(&y) {
                    covered += 1.0;
                    gray += if self.family.is_black(*number, x, y) { INK } else { PAPER };
                }
            }
            let all = (SAMPLES * SAMPLES) as f32;
            for channel in color.iter_mut() {
                *channel = (*channel * (all - covered) + gray) / all;
            }
        }
    }
}
