//! Local homography from the board plane to the image.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use odograph::geometry::Pixel;

/// A homography from the board plane to the image, valid around one position. Over a few squares,
/// lens distortion is negligible.
#[derive(Debug, Clone, Copy)]
pub(super) struct PlaneMap {
    centre: (f64, f64),
    scale: f64,
    h: [f64; 8],
    middle: Pixel,
    spread: f64,
}

/// A board position, its pixel, and a weight.
pub(super) type WeightedMatch = ((f64, f64), Pixel, f64);

/// Prior information of the perspective terms, relative to measurements of unit weight. Perspective
/// changes the scale by some 5 % over one spacing, and positions are measured to about a thousandth
/// of a spacing.
const PERSPECTIVE_PRIOR: f64 = 4e-4;

impl PlaneMap {
    /// The weighted least-squares homography (R. Hartley and A. Zisserman, "Multiple view
    /// geometry", 2nd edition, equation 4.2), in coordinates relative to `centre` in units of
    /// `scale`. A prior pulls the perspective terms to zero, so that few points determine a nearly
    /// affine map. `None` for fewer than three or nearly collinear points.
    pub fn fit(pairs: &[WeightedMatch], centre: (f64, f64), scale: f64) -> Option<Self> {
        if pairs.len() < 3 {
            return None;
        }
        let total: f64 = pairs.iter().map(|pair| pair.2).sum();
        let mean =
            |value: &dyn Fn(&WeightedMatch) -> f64| pairs.iter().map(|p| p.2 * value(p)).sum::<f64>() / total;
        let middle = Pixel::new(mean(&|p| p.1.x), mean(&|p| p.1.y));
        let spread = mean(&|p| p.1.distance(middle)).max(1e-9);
        let local = |p: &WeightedMatch| ((p.0.0 - centre.0) / scale, (p.0.1 - centre.1) / scale);
        let (mu, mv) = (mean(&|p| local(p).0), mean(&|p| local(p).1));
        let (uu, uv, vv) = (
            mean(&|p| (local(p).0 - mu).powi(2)),
            mean(&|p| (local(p).0 - mu) * (local(p).1 - mv)),
            mean(&|p| (local(p).1 - mv).powi(2)),
        );
        if uu * vv - uv * uv < 1e-3 * (uu + vv) * (uu + vv) {
            return None;
        }
        let mut normal = SMatrix::<f64, 8, 8>::zeros();
        let mut right = SVector::<f64, 8>::zeros();
        for pair in pairs {
            let (u, v) = local(pair);
            let (x, y, weight) = ((pair.1.x - middle.x) / spread, (pair.1.y - middle.y) / spread, pair.2);
            for (row, value) in [
                ([u, v, 1.0, 0.0, 0.0, 0.0, -u * x, -v * x], x),
                ([0.0, 0.0, 0.0, u, v, 1.0, -u * y, -v * y], y),
            ] {
                let row = SVector::from(row);
                normal += weight * row * row.transpose();
                right += weight * value * row;
            }
        }
        normal[(6, 6)] += PERSPECTIVE_PRIOR;
        normal[(7, 7)] += PERSPECTIVE_PRIOR;
        let h = normal.cholesky()?.solve(&right);
        h.iter().all(|value| value.is_finite()).then(|| Self { centre, scale, h: h.into(), middle, spread })
    }

    /// Maps a board position to the image; `None` beyond the horizon.
    pub fn pixel(&self, place: (f64, f64)) -> Option<Pixel> {
        let (u, v) = ((place.0 - self.centre.0) / self.scale, (place.1 - self.centre.1) / self.scale);
        let h = &self.h;
        let w = h[6] * u + h[7] * v + 1.0;
        (w > 0.05).then(|| {
            Pixel::new(
                self.middle.x + self.spread * (h[0] * u + h[1] * v + h[2]) / w,
                self.middle.y + self.spread * (h[3] * u + h[4] * v + h[5]) / w,
            )
        })
    }

    /// The inverse map; `None` if it is singular because the plane is seen edge-on.
    pub fn inverse(&self) -> Option<InversePlaneMap> {
        let h = &self.h;
        let matrix = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1.0);
        Some(InversePlaneMap { h: matrix.try_inverse()?, of: *self })
    }

    /// Image vectors of a `step` along x and along y on the board, pixels; central differences at a
    /// position.
    pub fn steps(&self, place: (f64, f64), step: f64) -> Option<[(f64, f64); 2]> {
        let small = 0.05;
        let difference = |a: Pixel, b: Pixel| ((b.x - a.x) / (2.0 * small), (b.y - a.y) / (2.0 * small));
        let d = small * step;
        let along_x = (self.pixel((place.0 - d, place.1))?, self.pixel((place.0 + d, place.1))?);
        let along_y = (self.pixel((place.0, place.1 - d))?, self.pixel((place.0, place.1 + d))?);
        Some([difference(along_x.0, along_x.1), difference(along_y.0, along_y.1)])
    }
}

/// The inverse map from the image to the board plane.
pub(super) struct InversePlaneMap {
    h: Matrix3<f64>,
    of: PlaneMap,
}

impl InversePlaneMap {
    /// Maps a pixel to the board plane; `None` on the horizon.
    pub fn at(&self, pixel: Pixel) -> Option<(f64, f64)> {
        let of = &self.of;
        let local = self.h
            * Vector3::new((pixel.x - of.middle.x) / of.spread, (pixel.y - of.middle.y) / of.spread, 1.0);
        let scale = of.scale / local.z;
        scale.is_finite().then(|| (of.centre.0 + scale * local.x, of.centre.1 + scale * local.y))
    }
}

/// Height of the parallelogram spanned by two image vectors: the smaller distance between opposite
/// sides, pixels.
pub(super) fn least_width(steps: [(f64, f64); 2]) -> f64 {
    let [(ax, ay), (bx, by)] = steps;
    (ax * by - ay * bx).abs() / ax.hypot(ay).max(bx.hypot(by)).max(1e-9)
}
