//! Georeference of a picture of the ground.

use super::GroundPoint;

/// Georeference of a north-up picture: columns run along world x, rows against world y, pixels are
/// square.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    /// Side of a pixel on the ground, metres.
    pub metres_per_pixel: f64,
    /// World x of the centre of the top-left pixel, metres.
    pub x_m: f64,
    /// World y of the centre of the top-left pixel, metres.
    pub y_m: f64,
}

impl Placement {
    /// The ground point at a pixel of the picture; pixel centres are at integer coordinates.
    pub fn ground_from_pixel(&self, column: f64, row: f64) -> GroundPoint {
        GroundPoint::new(self.x_m + column * self.metres_per_pixel, self.y_m - row * self.metres_per_pixel)
    }

    /// The pixel (column, row) of the picture that shows a ground point.
    pub fn pixel_from_ground(&self, point: GroundPoint) -> (f64, f64) {
        ((point.x_m - self.x_m) / self.metres_per_pixel, (self.y_m - point.y_m) / self.metres_per_pixel)
    }

    /// The six lines of a world file (`.pgw` beside a `.png`): A, D, B, E, C, F of `x = A column +
    /// B row + C`, `y = D column + E row + F`, (C, F) the centre of the top-left pixel (ESRI's
    /// definition).
    pub fn world_file(&self) -> String {
        let Self { metres_per_pixel: side, x_m, y_m } = self;
        format!("{side:?}\n0.0\n0.0\n{:?}\n{x_m:?}\n{y_m:?}\n", -side)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_world_file_says_where_each_pixel_is() {
        let placement = Placement { metres_per_pixel: 0.002, x_m: -1.25, y_m: 3.5 };
        let text = placement.world_file();
        let lines: Vec<f64> = text.lines().map(|line| line.parse().unwrap()).collect();
        assert_eq!(lines.len(), 6);
        let [a, d, b, e, c, f] = [lines[0], lines[1], lines[2], lines[3], lines[4], lines[5]];
        let (column, row) = (100.0, 40.0);
        let ground = placement.ground_from_pixel(column, row);
        assert!((a * column + b * row + c - ground.x_m).abs() < 1e-12);
        assert!((d * column + e * row + f - ground.y_m).abs() < 1e-12);
        assert!((ground.x_m - -1.05).abs() < 1e-12 && (ground.y_m - 3.42).abs() < 1e-12);
        let back = placement.pixel_from_ground(ground);
        assert!((back.0 - column).abs() < 1e-9 && (back.1 - row).abs() < 1e-9);
    }
}
