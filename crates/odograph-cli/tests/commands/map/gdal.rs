//! Maps read by GDAL and OGR; skipped with a message if these are not installed.

use super::ground;
use super::{made, odograph, text};
use nalgebra::Matrix3;
use odograph::geometry::Se2;
use odograph::keyframe::KeyframeId;
use odograph::landmark::{MarkerSighting, PlacedSighting};
use odograph_map::MapFile;
use serde_json::Value;
use std::path::Path;
use std::process::Command;

/// The output of a GDAL program; `None` if GDAL is not installed. Any warning is a failure.
fn gdal(program: &str, arguments: &[&str], folder: &Path) -> Option<String> {
    let output = match Command::new(program).args(arguments).current_dir(folder).output() {
        Ok(output) => output,
        Err(error) => {
            println!("skipped: gdal: {program} cannot be run here ({error}); apt-get install gdal-bin");
            return None;
        }
    };
    let complaints = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && complaints.trim().is_empty(), "{program} {arguments:?}: {complaints}");
    Some(String::from_utf8(output.stdout).unwrap())
}

fn number(text: &str, after: &str) -> f64 {
    let rest =
        &text[text.find(after).unwrap_or_else(|| panic!("{after:?} is not in\n{text}")) + after.len()..];
    let end = rest.find(|c: char| !(c.is_ascii_digit() || "+-.e".contains(c))).unwrap_or(rest.len());
    rest[..end].parse().unwrap_or_else(|_| panic!("{after:?} in\n{text}"))
}

/// A corner (x, y) in the output of gdalinfo.
fn corner(text: &str, name: &str) -> (f64, f64) {
    let line = text.lines().find(|line| line.starts_with(name)).unwrap();
    let inside = &line[line.find('(').unwrap() + 1..line.find(')').unwrap()];
    let (x, y) = inside.split_once(',').unwrap();
    (x.trim().parse().unwrap(), y.trim().parse().unwrap())
}

#[test]
fn gdal_opens_a_map_with_layers_tiles_and_extent() {
    let folder = made();
    let Some(layers) = gdal("ogrinfo", &["-ro", "-so", "-al", "map.gpkg"], folder.path()) else { return };
    assert!(layers.contains("Layer name: keyframes") && layers.contains("Geometry: Point"), "{layers}");
    assert!(layers.contains("Layer name: paths") && layers.contains("Geometry: Line String"), "{layers}");
    assert_eq!(number(&layers, "Feature Count: "), 12.0);
    // Keyframes range from (0, 0) to (1, 0.3).
    assert!(layers.contains("Extent: (0.000000, 0.000000) - (1.000000, 0.300000)"), "{layers}");
    let one = gdal(
        "ogrinfo",
        &["-ro", "-q", "map.gpkg", "-sql", "SELECT * FROM keyframes WHERE id = 4"],
        folder.path(),
    )
    .unwrap();
    assert!(one.contains("POINT (0.8 0") && one.contains("time_s (Real) = 1.432"), "{one}");
    let line = gdal("ogrinfo", &["-ro", "-q", "map.gpkg", "paths"], folder.path()).unwrap();
    let points = &line[line.find("LINESTRING (").unwrap() + 12..line.rfind(')').unwrap()];
    for (frame, point) in points.split(',').enumerate() {
        let (x, y) = point.split_once(' ').unwrap();
        let (x, y): (f64, f64) = (x.parse().unwrap(), y.parse().unwrap());
        let pose = ground::pose(frame as u64);
        assert!((x - pose.x_m).hypot(y - pose.y_m) < 1e-9, "{line}");
    }
    assert_eq!(points.split(',').count(), 12);
    // Each camera saw 0.6 m by 0.45 m, except for the image border.
    let picture = gdal("gdalinfo", &["map.gpkg"], folder.path()).unwrap();
    let ((left, top), (right, bottom)) = (corner(&picture, "Upper Left"), corner(&picture, "Lower Right"));
    assert!((-0.45..-0.1).contains(&left) && (1.1..1.45).contains(&right), "{picture}");
    assert!((-0.55..-0.2).contains(&bottom) && (0.5..0.85).contains(&top), "{picture}");
    assert!(picture.contains("Overviews"), "{picture}");
}

#[test]
fn gdal_reads_the_markers_of_a_map() {
    let folder = made();
    let mut map = MapFile::open(&folder.path().join("map.gpkg")).unwrap();
    let sighting = MarkerSighting {
        number: 7,
        keyframe: KeyframeId(4),
        keyframe_from_marker: Se2::new(0.1, 0.05, 0.7),
        covariance: Matrix3::identity() * 1e-8,
        side_m: 0.0801,
        side_sigma_m: 1e-4,
    };
    map.add_markers("apriltag:36h11", 0.08, &[PlacedSighting { sighting, place: 0, visit: 0 }]).unwrap();
    let place = map.landmarks().unwrap()[0].pose;
    map.close().unwrap();
    let Some(layers) = gdal("ogrinfo", &["-ro", "-so", "map.gpkg", "marker_sightings"], folder.path()) else {
        return;
    };
    assert!(layers.contains("Geometry: Point") && layers.contains("Feature Count: 1"), "{layers}");
    assert!((number(&layers, "Extent: (") - place.x_m).abs() < 1e-6, "{layers}");
    let one = gdal("ogrinfo", &["-ro", "-q", "map.gpkg", "marker_sightings"], folder.path()).unwrap();
    assert!((number(&one, "POINT (") - place.x_m).abs() < 1e-9, "{one}");
    for field in [
        "family (String) = apriltag:36h11",
        "number (Integer) = 7",
        "size_m (Real) = 0.08",
        "session (Integer) = 0",
    ] {
        assert!(one.replace("Integer64", "Integer").contains(field), "{field} in\n{one}");
    }
}

#[test]
fn exports_are_georeferenced_in_gdal() {
    let folder = made();
    if gdal("gdalinfo", &["--version"], folder.path()).is_none() {
        return;
    }
    let export = |arguments: &[&str]| {
        let (code, _, complaints) =
            text(&odograph(&[&["export", "map.gpkg"], arguments].concat(), folder.path()));
        assert_eq!((code, complaints.as_str()), (0, ""), "{arguments:?}");
    };
    export(&["-o", "floor.tif"]);
    export(&["-o", "floor.png"]);
    let size = |file: &str| {
        let info = gdal("gdalinfo", &[file], folder.path()).unwrap();
        let line = info.lines().find_map(|line| line.strip_prefix("Size is ")).unwrap();
        let (width, height) = line.split_once(", ").unwrap();
        [width, height].map(|pixels| pixels.parse::<u64>().unwrap())
    };
    // The tiles of the GeoTIFF add fewer than 512 transparent columns and rows, left and above.
    let more = [0, 1].map(|k| size("floor.tif")[k].checked_sub(size("floor.png")[k]));
    assert!(more.iter().all(|more| more.is_some_and(|more| more < 512)), "{more:?}");
    let floor = gdal("gdalinfo", &["floor.tif"], folder.path()).unwrap();
    assert!(floor.contains("LAYOUT=COG") && floor.contains("Overviews: "), "{floor}");
    export(&["-o", "placed.tif", "--anchor", "48.2082,16.3738,90"]);
    for name in ["path.geojson", "path.kml", "path.gpx"] {
        export(&["-o", name, "--anchor", "48.2082,16.3738,90"]);
    }
    // The ground has the same colours in the map, in the GeoTIFF, and in the PNG with its world
    // file.
    let color = |file: &str, x: &str, y: &str| {
        gdal("gdallocationinfo", &["-valonly", "-geoloc", file, x, y], folder.path())
    };
    for (x, y) in [("0.3", "0.1"), ("0.71", "-0.05"), ("0.05", "0.22")] {
        let expected = color("map.gpkg", x, y).unwrap();
        assert!(expected.lines().count() == 4 && expected.trim_end().ends_with("255"), "{expected}");
        assert_eq!(color("floor.tif", x, y).unwrap(), expected);
        assert_eq!(color("floor.png", x, y).unwrap(), expected);
    }
    let placed = gdal("gdalinfo", &["-json", "placed.tif"], folder.path()).unwrap();
    let placed: Value = serde_json::from_str(&placed).unwrap();
    assert!(placed["coordinateSystem"]["wkt"].as_str().unwrap().contains("UTM zone 33N"), "{placed}");
    // The ninth frame was at (0.6, 0.3).
    let path = std::fs::read_to_string(folder.path().join("path.geojson")).unwrap();
    let path: Value = serde_json::from_str(&path).unwrap();
    let ninth = &path["features"][0]["geometry"]["coordinates"][8];
    let [longitude, latitude] = [0, 1].map(|k| ninth[k].to_string());
    let at = ["-valonly", "-wgs84", "placed.tif", &longitude, &latitude];
    let at = gdal("gdallocationinfo", &at, folder.path()).unwrap();
    assert_eq!(at, color("map.gpkg", "0.6", "0.3").unwrap());
    let layer = gdal("ogrinfo", &["-ro", "-so", "-al", "path.geojson"], folder.path()).unwrap();
    assert!(layer.contains("Feature Count: 13") && layer.contains("WGS 84"), "{layer}");
    let kml = gdal("ogrinfo", &["-ro", "-so", "-al", "path.kml"], folder.path()).unwrap();
    assert_eq!(number(&kml, "Feature Count: "), 1.0);
    let gpx = gdal("ogrinfo", &["-ro", "-so", "path.gpx", "tracks"], folder.path()).unwrap();
    assert_eq!(number(&gpx, "Feature Count: "), 1.0);
}
