//! Positions on Earth (WGS 84): longitude and latitude, a plane that touches the ellipsoid, UTM.

/// WGS 84: semi-major axis, metres, and flattening.
const SEMI_MAJOR_M: f64 = 6_378_137.0;
const FLATTENING: f64 = 1.0 / 298.257_223_563;
const ECCENTRICITY_SQUARED: f64 = FLATTENING * (2.0 - FLATTENING);

/// Latitude and longitude, radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EarthPosition {
    /// Geodetic latitude, positive to the north.
    pub latitude_rad: f64,
    /// Longitude, positive to the east.
    pub longitude_rad: f64,
}

/// A plane parallel to the one that touches the ellipsoid at a reference, at an altitude above it,
/// with metres east and north of the reference. A kilometre away it is 0.08 m above the ground, and
/// distances in it are exact to a hundredth of a millimetre.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TangentPlane {
    /// Where east and north are zero.
    pub reference: EarthPosition,
    /// Altitude above the ellipsoid, metres. Each kilometre makes distances larger by 0.16 ‰.
    pub altitude_m: f64,
}

impl EarthPosition {
    /// Latitude and longitude in degrees; `None` where they are no place that a map can be at: a
    /// latitude beyond ±89.9°, a longitude beyond ±360°, or no number.
    pub fn from_degrees(latitude_deg: f64, longitude_deg: f64) -> Option<Self> {
        let is_place = latitude_deg.abs() <= 89.9 && longitude_deg.abs() <= 360.0;
        is_place.then(|| Self {
            latitude_rad: latitude_deg.to_radians(),
            longitude_rad: longitude_deg.to_radians(),
        })
    }

    /// Number of the UTM zone, 1 to 60. The exceptions of Norway and Svalbard are left out.
    pub fn utm_zone(&self) -> u16 {
        (((self.longitude_rad.to_degrees() + 180.0) / 6.0).floor() as i64).rem_euclid(60) as u16 + 1
    }

    /// Easting and northing in a UTM zone, of the southern hemisphere if `south`, metres.
    pub fn utm(&self, zone: u16, south: bool) -> (f64, f64) {
        let (east, north) = self.transverse_mercator((6.0 * f64::from(zone) - 183.0).to_radians());
        (500_000.0 + east, north + if south { 1e7 } else { 0.0 })
    }

    /// The point in Earth's frame, metres: x towards longitude 0, z towards the pole.
    fn geocentric(&self, altitude_m: f64) -> [f64; 3] {
        let (sin, cos) = self.latitude_rad.sin_cos();
        let normal_m = SEMI_MAJOR_M / (1.0 - ECCENTRICITY_SQUARED * sin * sin).sqrt();
        let (sin_longitude, cos_longitude) = self.longitude_rad.sin_cos();
        [
            (normal_m + altitude_m) * cos * cos_longitude,
            (normal_m + altitude_m) * cos * sin_longitude,
            (normal_m * (1.0 - ECCENTRICITY_SQUARED) + altitude_m) * sin,
        ]
    }

    /// The directions east and north in Earth's frame.
    fn east_and_north(&self) -> [[f64; 3]; 2] {
        let (sin, cos) = self.latitude_rad.sin_cos();
        let (sin_longitude, cos_longitude) = self.longitude_rad.sin_cos();
        [[-sin_longitude, cos_longitude, 0.0], [-sin * cos_longitude, -sin * sin_longitude, cos]]
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

impl TangentPlane {
    /// East and north of a place at the plane's altitude, metres.
    pub fn point(&self, place: EarthPosition) -> [f64; 2] {
        let (here, there) = (self.reference.geocentric(self.altitude_m), place.geocentric(self.altitude_m));
        self.reference.east_and_north().map(|axis| (0..3).map(|k| axis[k] * (there[k] - here[k])).sum())
    }

    /// The place below a point of the plane (Bowring's iteration for the latitude; two steps are
    /// exact to a nanometre this near the ground).
    pub fn place(&self, [east, north]: [f64; 2]) -> EarthPosition {
        let here = self.reference.geocentric(self.altitude_m);
        let [along_east, along_north] = self.reference.east_and_north();
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
        EarthPosition { latitude_rad, longitude_rad: y.atan2(x) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn utm_is_that_of_the_standard_projection() {
        // GDAL 3.6.2: `echo 16.3738 48.2082 | gdaltransform -s_srs EPSG:4326 -t_srs EPSG:32633`,
        // and the same for zone 56 south.
        for (latitude, longitude, zone, expected) in [
            (48.2082, 16.3738, 33, (602_065.207, 5_340_353.594)),
            (-33.8568, 151.2153, 56, (334_900.570, 6_252_288.753)),
        ] {
            let place = EarthPosition::from_degrees(latitude, longitude).unwrap();
            assert_eq!(place.utm_zone(), zone);
            let (east, north) = place.utm(zone, latitude < 0.0);
            assert!((east - expected.0).hypot(north - expected.1) < 0.001, "{east} {north}");
        }
    }

    #[test]
    fn what_is_no_place_is_refused() {
        for (latitude, longitude) in [(91.0, 0.0), (-90.0, 0.0), (f64::NAN, 0.0), (0.0, f64::INFINITY)] {
            assert_eq!(EarthPosition::from_degrees(latitude, longitude), None);
        }
    }

    proptest! {
        #[test]
        fn a_plane_and_the_earth_agree(latitude in -80.0..80.0, longitude in -180.0..180.0,
                                       altitude_m in -100.0..4000.0, east in -2e3..2e3, north in -2e3..2e3) {
            let reference = EarthPosition::from_degrees(latitude, longitude).unwrap();
            let plane = TangentPlane { reference, altitude_m };
            let [there_east, there_north] = plane.point(plane.place([east, north]));
            // The place is below the point of the plane, whose foot is nearer by its height over
            // the ground, 0.3 m at 2 km.
            prop_assert!((there_east - east).hypot(there_north - north) < 4e-4);
        }
    }
}
