//! The paths and keyframes of a map in longitude and latitude: GeoJSON (RFC 7946), KML 2.2, GPX
//! 1.1.

use crate::files;
use odograph::error::{Error, Result};
use odograph::formats::geojson::{self, Feature, degrees, quoted};
use odograph::geometry::EarthPosition;
use odograph::georeference::Anchor;
use odograph_map::{MapFile, PathFrame, connected_stretches};
use std::fmt::Write;
use std::path::Path;

/// The formats with positions on Earth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GeographicForm {
    GeoJson,
    Kml,
    Gpx,
}

/// A part of the path without a gap.
struct GeographicLine {
    session: u32,
    source: String,
    segment: usize,
    start_s: f64,
    end_s: f64,
    places: Vec<EarthPosition>,
}

/// A keyframe on Earth.
struct GeographicPoint {
    id: u64,
    session: u32,
    time_s: f64,
    place: EarthPosition,
}

/// Writes all sessions and says what was written.
pub fn write(file: &MapFile, path: &Path, form: GeographicForm, anchor: &Anchor) -> Result<String> {
    let mut lines = Vec::new();
    for session in file.sessions()? {
        let frames = file.path_of(session.id)?;
        for stretch in connected_stretches(&frames).filter(|stretch| stretch.len() > 1) {
            let place = |frame: &PathFrame| anchor.place(frame.pose.x_m, frame.pose.y_m);
            lines.push(GeographicLine {
                session: session.id,
                source: session.source.clone(),
                segment: stretch[0].segment,
                start_s: stretch[0].time_s,
                end_s: stretch[stretch.len() - 1].time_s,
                places: stretch.iter().map(place).collect(),
            });
        }
    }
    let keyframes = file.map()?.keyframes;
    if lines.is_empty() && keyframes.is_empty() {
        return Err(Error::input(format!("{} has no path and no keyframe to write", file.path().display())));
    }
    let points: Vec<GeographicPoint> = keyframes
        .iter()
        .map(|keyframe| GeographicPoint {
            id: keyframe.id.0,
            session: keyframe.session,
            time_s: keyframe.time_s,
            place: anchor.place(keyframe.pose.x_m, keyframe.pose.y_m),
        })
        .collect();
    let text = match form {
        GeographicForm::GeoJson => geojson(&lines, &points),
        GeographicForm::Kml => kml(&lines),
        GeographicForm::Gpx => gpx(&lines),
    };
    files::write(path, text.as_bytes())?;
    let stretches = if lines.len() == 1 { "stretch" } else { "stretches" };
    Ok(format!("{} {stretches} of path, {} keyframes", lines.len(), points.len()))
}

fn geojson(lines: &[GeographicLine], points: &[GeographicPoint]) -> String {
    let path = |line: &GeographicLine| Feature {
        properties: vec![
            ("session", line.session.to_string()),
            ("source", quoted(&line.source)),
            ("segment", line.segment.to_string()),
            ("start_s", format!("{:?}", line.start_s)),
            ("end_s", format!("{:?}", line.end_s)),
        ],
        places: line.places.clone(),
    };
    let keyframe = |point: &GeographicPoint| Feature {
        properties: vec![
            ("keyframe", point.id.to_string()),
            ("session", point.session.to_string()),
            ("time_s", format!("{:?}", point.time_s)),
        ],
        places: vec![point.place],
    };
    let features: Vec<Feature> = lines.iter().map(path).chain(points.iter().map(keyframe)).collect();
    geojson::write(&features)
}

fn kml(lines: &[GeographicLine]) -> String {
    let mut text = String::from(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<kml xmlns=\"http://www.opengis.net/kml/2.2\">\n<Document>\n",
    );
    for line in lines {
        let _ = write!(
            text,
            "<Placemark><name>{} ({})</name><LineString><tessellate>1</tessellate><coordinates>",
            escaped(&line.source),
            line.segment
        );
        for place in &line.places {
            let (longitude, latitude) = degrees(place);
            let _ = write!(text, "{longitude},{latitude} ");
        }
        text.push_str("</coordinates></LineString></Placemark>\n");
    }
    text + "</Document>\n</kml>\n"
}

fn gpx(lines: &[GeographicLine]) -> String {
    let mut text = String::from(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<gpx version=\"1.1\" creator=\"odograph\" \
         xmlns=\"http://www.topografix.com/GPX/1/1\">\n",
    );
    for session in lines.chunk_by(|a, b| a.session == b.session) {
        let _ = writeln!(text, "<trk><name>{}</name>", escaped(&session[0].source));
        for line in session {
            text.push_str("<trkseg>\n");
            for place in &line.places {
                let (longitude, latitude) = degrees(place);
                let _ = writeln!(text, "<trkpt lat=\"{latitude}\" lon=\"{longitude}\"/>");
            }
            text.push_str("</trkseg>\n");
        }
        text.push_str("</trk>\n");
    }
    text + "</gpx>\n"
}

/// Text inside of XML; what XML cannot hold at all is left out.
fn escaped(text: &str) -> String {
    let kept = text.chars().filter(|c| !c.is_control());
    kept.map(|c| match c {
        '&' => "&amp;".to_owned(),
        '<' => "&lt;".to_owned(),
        '>' => "&gt;".to_owned(),
        '"' => "&quot;".to_owned(),
        other => other.to_string(),
    })
    .collect()
}
