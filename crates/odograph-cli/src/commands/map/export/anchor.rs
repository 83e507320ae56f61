//! Where on Earth a map is: its plane as the tangent plane of the ellipsoid, converted to longitude
//! and latitude, and to UTM.

use odograph::error::{Error, Result};
use std::str::FromStr;

/// WGS 84: semi-major axis, metres, and flattening.
const SEMI_MAJOR_M: f64 = 6_378_137.0;
const FLATTENING: f64 = 1.0 / 298.257_223_563;
const ECCENTRICITY_SQUARED: f64 = FLATTENING * (2.0 - FLATTENING);

/// Latitude and longitude, radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EarthPosition {
    pub latitude_rad: f64,
    pub longitude_rad: f64,
}

/// What is given on the command line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AnchorArgument {
    /// The map's origin, and the compass heading of its x, radians.
    Start(EarthPosition, f64),
    /// A point of the map, metres, and where it is.
    Point([f64; 2], EarthPosition),
}

impl FromStr for AnchorArgument {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let numbers = |text: &str| -> Option<Vec<f64>> {
            let numbers =
                text.split(',').map(|number| number.trim().parse::<f64>().ok().filter(|n| n.is_finite()));
            numbers.collect()
        };
        let place = |latitude: f64, longitude: f64| {
            if latitude.abs() > 89.9 || longitude.abs() > 360.0 {
                return Err(format!(
                    "latitude {latitude}, longitude {longitude} is no place that a map can be at; give degrees, latitude first"
                ));
            }
            Ok(EarthPosition { latitude_rad: latitude.to_radians(), longitude_rad: longitude.to_radians() })
        };
        let parts = match text.split_once('=') {
            Some((point, at)) => (numbers(point), numbers(at)),
            None => (Some(vec![]), numbers(text)),
        };
        match (parts.0.as_deref(), parts.1.as_deref()) {
            (Some([]), Some(&[latitude, longitude, heading])) => {
                Ok(Self::Start(place(latitude, longitude)?, heading.to_radians()))
            }
            (Some(&[x_m, y_m]), Some(&[latitude, longitude])) => {
                Ok(Self::Point([x_m, y_m], place(latitude, longitude)?))
            }
            _ => {
                Err("give LAT,LON,HEADING of the map's origin, or X,Y=LAT,LON for each of two points"
                    .to_owned())
            }
        }
    }
}

/// A map's place on Earth: a similarity from the map to metres east and north of a reference, in
/// the plane that touches the ellipsoid there. A kilometre from the reference that plane is 0.08 m
/// above the ground, and distances in it are exact to a hundredth of a millimetre.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Anchor {
    reference: EarthPosition,
    /// East and north of the map's origin, metres.
    origin_m: [f64; 2],
    /// East and north of one metre along the map's x; along its y it is this turned to the left.
    along: [f64; 2],
    zone: u16,
}

impl Anchor {
    /// The anchor that the arguments give; `None` if there are none.
    pub fn of(arguments: &[AnchorArgument]) -> Result<Option<Self>> {
        let zone = |place: &EarthPosition| {
            (((place.longitude_rad.to_degrees() + 180.0) / 6.0).floor() as i64).rem_euclid(60) as u16 + 1
        };
        match *arguments {
            [] => Ok(None),
            [AnchorArgument::Start(reference, heading_rad)] => Ok(Some(Self {
                reference,
                origin_m: [0.0; 2],
                along: [heading_rad.sin(), heading_rad.cos()],
                zone: zone(&reference),
            })),
            [AnchorArgument::Point(a, reference), AnchorArgument::Point(b, other)] => {
                let [east, north] = reference.to_tangent_plane(other);
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
                Ok(Some(Self { reference, origin_m, along, zone: zone(&reference) }))
            }
            _ => Err(Error::usage("give --anchor once as LAT,LON,HEADING, or twice as X,Y=LAT,LON")),
        }
    }

    /// Where a point of the map is.
    pub fn place(&self, x_m: f64, y_m: f64) -> EarthPosition {
        let [along, across] = self.along;
        self.reference.of_tangent_plane([
            self.origin_m[0] + x_m * along - y_m * across,
            self.origin_m[1] + x_m * across + y_m * along,
        ])
    }

    /// EPSG's number of the UTM zone that the map is in.
    pub fn utm_code(&self) -> u16 {
        if self.reference.latitude_rad < 0.0 { 32_700 + self.zone } else { 32_600 + self.zone }
    }

    /// East and north of a point of the map in that zone, metres.
    pub fn utm(&self, x_m: f64, y_m: f64) -> (f64, f64) {
        let place = self.place(x_m, y_m);
        let central_rad = (6.0 * f64::from(self.zone) - 183.0).to_radians();
        let (east, north) = place.transverse_mercator(central_rad);
        let false_north = if self.reference.latitude_rad < 0.0 { 1e7 } else { 0.0 };
        (500_000.0 + east, false_north + north)
    }
}

impl EarthPosition {
    /// The point in Earth's frame, metres: x towards longitude 0, z towards the pole.
    fn geocentric(&self) -> [f64; 3] {
        let (sin, cos) = self.latitude_rad.sin_cos();
        let normal_m = SEMI_MAJOR_M / (1.0 - ECCENTRICITY_SQUARED * sin * sin).sqrt();
        let (sin_longitude, cos_longitude) = self.longitude_rad.sin_cos();
        [
            normal_m * cos * cos_longitude,
            normal_m * cos * sin_longitude,
            normal_m * (1.0 - ECCENTRICITY_SQUARED) * sin,
        ]
    }

    /// The directions east and north in Earth's frame.
    fn east_and_north(&self) -> [[f64; 3]; 2] {
        let (sin, cos) = self.latitude_rad.sin_cos();
        let (sin_longitude, cos_longitude) = self.longitude_rad.sin_cos();
        [[-sin_longitude, cos_longitude, 0.0], [-sin * cos_longitude, -sin * sin_longitude, cos]]
    }

    /// East and north of another place, metres, in the plane that touches the ellipsoid here.
    fn to_tangent_plane(self, other: Self) -> [f64; 2] {
        let (here, there) = (self.geocentric(), other.geocentric());
        self.east_and_north().map(|axis| (0..3).map(|k| axis[k] * (there[k] - here[k])).sum())
    }

    /// The place below a point of that plane (Bowring's iteration for the latitude; two steps are
    /// exact to a nanometre this near the ground).
    fn of_tangent_plane(self, [east, north]: [f64; 2]) -> Self {
        let (here, [along_east, along_north]) = (self.geocentric(), self.east_and_north());
        let at = |k: usize| here[k] + east * along_east[k] + north * along_north[k];
        let (x, y, z) = (at(0), at(1), at(2));
        let from_axis = x.hypot(y);
        let semi_minor_m = SEMI_MAJOR_M * (1.0 - FLATTENING);
        let second = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED);
        let mut reduced = (z * SEMI_MAJOR_M).atan2(from_axis * semi_minor_m);
        let mut latitude_rad = 0.0;
        for _ in 0..2 {
            let (sin, cos) = reduced.sin_cos();
            latitude_rad = (z + second * semi_minor_m * sin.powi(3))
                .atan2(from_axis - ECCENTRICITY_SQUARED * SEMI_MAJOR_M * cos.powi(3));
            reduced = ((1.0 - FLATTENING) * latitude_rad.tan()).atan();
        }
        Self { latitude_rad, longitude_rad: y.atan2(x) }
    }

    /// East and north in metres on a transverse Mercator projection with UTM's scale of 0.9996 (L.
    /// Krüger, "Konforme Abbildung des Erdellipsoids in der Ebene", 1912, to the fourth power of n:
    /// C. F. F. Karney, "Transverse Mercator with an accuracy of a few nanometers", 2011, equations
    /// 7 to 12).
    fn transverse_mercator(&self, central_rad: f64) -> (f64, f64) {
        const SCALE: f64 = 0.9996;
        let n = FLATTENING / (2.0 - FLATTENING);
        let eccentricity = ECCENTRICITY_SQUARED.sqrt();
        let rectifying_m = SEMI_MAJOR_M / (1.0 + n) * (1.0 + n * n / 4.0 + n.powi(4) / 64.0);
        let alpha = [
            n / 2.0 - 2.0 / 3.0 * n.powi(2) + 5.0 / 16.0 * n.powi(3) + 41.0 / 180.0 * n.powi(4),
            13.0 / 48.0 * n.powi(2) - 3.0 / 5.0 * n.powi(3) + 557.0 / 1440.0 * n.powi(4),
            61.0 / 240.0 * n.powi(3) - 103.0 / 140.0 * n.powi(4),
            49_561.0 / 161_280.0 * n.powi(4),
        ];
        let tau = self.latitude_rad.tan();
        let sigma = (eccentricity * (eccentricity * self.latitude_rad.sin()).atanh()).sinh();
        let conformal = tau * (1.0 + sigma * sigma).sqrt() - sigma * (1.0 + tau * tau).sqrt();
        let (sin, cos) = (self.longitude_rad - central_rad).sin_cos();
        let xi = conformal.atan2(cos);
        let eta = (sin / conformal.hypot(cos)).asinh();
        let (mut north, mut east) = (xi, eta);
        for (k, alpha) in alpha.into_iter().enumerate() {
            let twice = 2.0 * (k + 1) as f64;
            north += alpha * (twice * xi).sin() * (twice * eta).cosh();
            east += alpha * (twice * xi).cos() * (twice * eta).sinh();
        }
        (SCALE * rectifying_m * east, SCALE * rectifying_m * north)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn anchor(texts: &[&str]) -> Result<Option<Anchor>> {
        Anchor::of(&texts.iter().map(|text| text.parse().unwrap()).collect::<Vec<_>>())
    }

    #[test]
    fn utm_is_that_of_the_standard_projection() {
        // GDAL 3.6.2: `echo 16.3738 48.2082 | gdaltransform -s_srs EPSG:4326 -t_srs EPSG:32633`,
        // and the same for zone 56 south.
        for (text, code, expected) in [
            ("48.2082,16.3738,0", 32_633, (602_065.207, 5_340_353.594)),
            ("-33.8568,151.2153,0", 32_756, (334_900.570, 6_252_288.753)),
        ] {
            let anchor = anchor(&[text]).unwrap().unwrap();
            let (east, north) = anchor.utm(0.0, 0.0);
            assert_eq!(anchor.utm_code(), code);
            assert!((east - expected.0).hypot(north - expected.1) < 0.001, "{east} {north}");
        }
    }

    #[test]
    fn a_heading_and_two_points_say_the_same() {
        let start = anchor(&["48.2082,16.3738,93.5"]).unwrap().unwrap();
        let text = |x: f64, y: f64| {
            let place = start.place(x, y);
            format!(
                "{x},{y}={:.12},{:.12}",
                place.latitude_rad.to_degrees(),
                place.longitude_rad.to_degrees()
            )
        };
        let points = anchor(&[&text(-3.0, 5.0), &text(40.0, -20.0)]).unwrap().unwrap();
        let (a, b) = (start.utm(12.0, 7.0), points.utm(12.0, 7.0));
        assert!((a.0 - b.0).hypot(a.1 - b.1) < 1e-4, "{a:?} {b:?}");
        // Heading 93.5: x of the map runs east and a little south.
        let (origin, ahead) = (start.utm(0.0, 0.0), start.utm(10.0, 0.0));
        assert!(ahead.0 - origin.0 > 9.9 && ahead.1 - origin.1 < -0.3);
    }

    #[test]
    fn what_is_no_anchor_is_refused() {
        for text in ["", "48.2", "48.2,16.3", "91,16,0", "1,2=3", "a,b,c", "nan,1,2"] {
            assert!(text.parse::<AnchorArgument>().is_err(), "{text:?}");
        }
        assert!(anchor(&["0,0=48,16", "1,0=48,17"]).is_err(), "a metre is no 74 km");
        assert!(anchor(&["0,0=48,16", "0,0=48,16"]).is_err());
        assert!(anchor(&["0,0=48,16"]).is_err());
        assert!(anchor(&[]).unwrap().is_none());
    }
}
