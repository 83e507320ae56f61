//! The ground in messages: as a grid, and as a picture with its georeference.

use super::cdr::Cdr;
use nalgebra::Isometry3;

/// A north-up raster on the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundRaster {
    /// Side of a cell or pixel, metres.
    pub resolution_m: f64,
    /// Number of cells along x.
    pub width: usize,
    /// Number of cells along y.
    pub height: usize,
    /// x and y of the corner where both are least, metres.
    pub corner_m: [f64; 2],
}

/// A cell of an occupancy grid that is free.
const FREE: u8 = 0;
/// A cell of an occupancy grid that is unknown: −1.
const UNKNOWN: u8 = u8::MAX;

/// `nav_msgs/msg/OccupancyGrid`: cells that were seen are free, others unknown. The cells are row
/// by row along x, that of the least y first.
pub fn occupancy_grid(time_ns: u64, frame: &str, raster: &GroundRaster, seen: &[bool]) -> Vec<u8> {
    let mut message = Cdr::new();
    message.header(time_ns, frame);
    meta_data(&mut message, time_ns, raster);
    let cells: Vec<u8> = seen.iter().map(|&seen| if seen { FREE } else { UNKNOWN }).collect();
    message.bytes(&cells);
    message.finished()
}

/// `nav_msgs/msg/MapMetaData`: where a raster is. Its cell (0, 0) is at the corner of least x and
/// y.
pub fn map_meta_data(time_ns: u64, raster: &GroundRaster) -> Vec<u8> {
    let mut message = Cdr::new();
    meta_data(&mut message, time_ns, raster);
    message.finished()
}

fn meta_data(message: &mut Cdr, time_ns: u64, raster: &GroundRaster) {
    let [x_m, y_m] = raster.corner_m;
    message.time(time_ns);
    message.f32(raster.resolution_m as f32);
    message.u32(raster.width as u32);
    message.u32(raster.height as u32);
    message.pose(&Isometry3::translation(x_m, y_m, 0.0));
}

/// `sensor_msgs/msg/CompressedImage`.
pub fn compressed_image(time_ns: u64, frame: &str, format: &str, data: &[u8]) -> Vec<u8> {
    let mut message = Cdr::new();
    message.header(time_ns, frame);
    message.text(format);
    message.bytes(data);
    message.finished()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_ends_with_its_cells() {
        let raster = GroundRaster { resolution_m: 0.05, width: 3, height: 1, corner_m: [1.0, -2.0] };
        let message = occupancy_grid(1_000_000_002, "map", &raster, &[true, false, true]);
        // Header with 8 bytes of time, 4 of length and "map" with its zero; 8 of time, three
        // numbers of 4 bytes; behind 36 bytes 4 for the alignment of seven doubles.
        let info = 4 + 16 + 8 + 12 + 4;
        assert_eq!(message.len(), info + 56 + 4 + 3);
        assert_eq!(message[info..info + 8], 1.0_f64.to_le_bytes());
        assert_eq!(message[info + 8..info + 16], (-2.0_f64).to_le_bytes());
        assert_eq!(message[info + 56..], [3, 0, 0, 0, 0, 255, 0]);
        assert_eq!(map_meta_data(1_000_000_002, &raster)[4..4 + 8], [1, 0, 0, 0, 2, 0, 0, 0]);
    }
}
