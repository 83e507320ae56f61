//! Where on Earth a map is.

use crate::error::{Error, Result};
use crate::geometry::{EarthPosition, Sim2, TangentPlane};
use nalgebra::Vector2;

/// A map's place on Earth: a similarity from the map to metres east and north of a reference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Anchor {
    plane: TangentPlane,
    /// East and north of the map's origin, metres.
    origin_m: [f64; 2],
    /// East and north of one metre along the map's x; along its y it is this turned to the left.
    along: [f64; 2],
    zone: u16,
}

impl Anchor {
    /// By the position of the map's origin in a plane, and east and north of one metre along its x.
    pub fn new(plane: TangentPlane, origin_m: [f64; 2], along: [f64; 2]) -> Self {
        let zone = plane.place(origin_m).utm_zone();
        Self { plane, origin_m, along, zone }
    }

    /// By the place of the map's origin, and the compass heading of its x, radians.
    pub fn at(origin: EarthPosition, bearing_rad: f64) -> Self {
        let plane = TangentPlane { reference: origin, altitude_m: 0.0 };
        Self::new(plane, [0.0; 2], [bearing_rad.sin(), bearing_rad.cos()])
    }

    /// By two points of the map, metres, and their places.
    ///
    /// # Errors
    /// If their distance on Earth is not about that on the map.
    pub fn through(points: [([f64; 2], EarthPosition); 2]) -> Result<Self> {
        let [(a, reference), (b, other)] = points;
        let plane = TangentPlane { reference, altitude_m: 0.0 };
        let [east, north] = plane.point(other);
        let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
        let square = dx * dx + dy * dy;
        // (east, north) as a complex number over (dx, dy) as one.
        let along = [(east * dx + north * dy) / square, (north * dx - east * dy) / square];
        let scale = along[0].hypot(along[1]);
        if !(0.5..2.0).contains(&scale) {
            return Err(Error::usage(format!(
                "the two points of --anchor are {:.2} m apart on the map and {:.2} m on Earth; check both",
                square.sqrt(),
                east.hypot(north)
            )));
        }
        let origin_m = [-(a[0] * along[0] - a[1] * along[1]), -(a[0] * along[1] + a[1] * along[0])];
        Ok(Self { zone: reference.utm_zone(), ..Self::new(plane, origin_m, along) })
    }

    /// Where a point of the map is.
    pub fn place(&self, x_m: f64, y_m: f64) -> EarthPosition {
        let [along, across] = self.along;
        self.plane.place([
            self.origin_m[0] + x_m * along - y_m * across,
            self.origin_m[1] + x_m * across + y_m * along,
        ])
    }

    /// A place in the plane at the reference: east and north, metres.
    pub fn in_plane_m(&self, place: EarthPosition) -> Vector2<f64> {
        Vector2::from(self.plane.point(place))
    }

    /// The similarity from the map to that plane.
    pub fn plane_from_map(&self) -> Sim2 {
        let [along, across] = self.along;
        let [x_m, y_m] = self.origin_m;
        Sim2 { x_m, y_m, heading_rad: across.atan2(along), scale: along.hypot(across) }
    }

    /// Compass heading of a direction of the map (counter-clockwise from its x), radians, 0 to 2π.
    pub fn bearing_rad(&self, heading_rad: f64) -> f64 {
        let [along, across] = self.along;
        (std::f64::consts::FRAC_PI_2 - across.atan2(along) - heading_rad).rem_euclid(std::f64::consts::TAU)
    }

    /// EPSG's number of the UTM zone that the map is in.
    pub fn utm_code(&self) -> u16 {
        if self.is_south() { 32_700 + self.zone } else { 32_600 + self.zone }
    }

    /// East and north of a point of the map in that zone, metres.
    pub fn utm(&self, x_m: f64, y_m: f64) -> (f64, f64) {
        self.place(x_m, y_m).utm(self.zone, self.is_south())
    }

    fn is_south(&self) -> bool {
        self.plane.reference.latitude_rad < 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_heading_and_two_points_say_the_same() {
        let start = Anchor::at(EarthPosition::from_degrees(48.2082, 16.3738).unwrap(), 93.5f64.to_radians());
        let point = |x: f64, y: f64| ([x, y], start.place(x, y));
        let points = Anchor::through([point(-3.0, 5.0), point(40.0, -20.0)]).unwrap();
        let (a, b) = (start.utm(12.0, 7.0), points.utm(12.0, 7.0));
        assert!((a.0 - b.0).hypot(a.1 - b.1) < 1e-4, "{a:?} {b:?}");
        // Heading 93.5: x of the map runs east and a little south.
        let (origin, ahead) = (start.utm(0.0, 0.0), start.utm(10.0, 0.0));
        assert!(ahead.0 - origin.0 > 9.9 && ahead.1 - origin.1 < -0.3);
        assert!((start.bearing_rad(0.0).to_degrees() - 93.5).abs() < 1e-9);
        assert!((start.bearing_rad(std::f64::consts::FRAC_PI_2).to_degrees() - 3.5).abs() < 1e-9);
    }

    #[test]
    fn two_points_that_contradict_the_map_are_refused() {
        let [here, there] =
            [16.0, 17.0].map(|longitude| EarthPosition::from_degrees(48.0, longitude).unwrap());
        assert!(Anchor::through([([0.0; 2], here), ([1.0, 0.0], there)]).is_err(), "a metre is no 74 km");
        assert!(Anchor::through([([0.0; 2], here), ([0.0; 2], here)]).is_err());
    }
}
