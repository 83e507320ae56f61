//! Paths and points on Earth as GeoJSON (RFC 7946).

use crate::geometry::EarthPosition;

/// A line through places, or a point where there is only one.
#[derive(Debug, Clone, PartialEq)]
pub struct Feature {
    /// Names and values; the values are JSON.
    pub properties: Vec<(&'static str, String)>,
    /// Its places in order.
    pub places: Vec<EarthPosition>,
}

/// Longitude and latitude in degrees, to a tenth of a millimetre.
pub fn degrees(place: &EarthPosition) -> (String, String) {
    (format!("{:.9}", place.longitude_rad.to_degrees()), format!("{:.9}", place.latitude_rad.to_degrees()))
}

/// A text as a JSON string.
pub fn quoted(text: &str) -> String {
    let mut quoted = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            c if c.is_control() => quoted.push_str(&format!("\\u{:04x}", u32::from(c))),
            c => quoted.push(c),
        }
    }
    quoted + "\""
}

/// A collection of features, one on each line.
pub fn write(features: &[Feature]) -> String {
    let lines: Vec<String> = features.iter().map(line).collect();
    format!("{{\"type\":\"FeatureCollection\",\"features\":[\n{}\n]}}\n", lines.join(",\n"))
}

fn line(feature: &Feature) -> String {
    let properties: Vec<String> =
        feature.properties.iter().map(|(name, value)| format!("\"{name}\":{value}")).collect();
    let positions: Vec<String> = feature
        .places
        .iter()
        .map(|place| {
            let (longitude, latitude) = degrees(place);
            format!("[{longitude},{latitude}]")
        })
        .collect();
    let (kind, coordinates) = match positions.as_slice() {
        [only] => ("Point", only.clone()),
        all => ("LineString", format!("[{}]", all.join(","))),
    };
    format!(
        "{{\"type\":\"Feature\",\"properties\":{{{}}},\"geometry\":{{\"type\":\"{kind}\",\"coordinates\":{coordinates}}}}}",
        properties.join(",")
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_and_a_point_are_features_with_their_properties() {
        let [a, b] = [48.25, 48.5].map(|latitude| EarthPosition::from_degrees(latitude, 16.0).unwrap());
        let path = Feature { properties: vec![("source", quoted("a \"b\"\n"))], places: vec![a, b] };
        let point = Feature {
            properties: vec![("keyframe", "3".to_owned()), ("time_s", "0.5".to_owned())],
            places: vec![a],
        };
        let text = write(&[path, point]);
        assert_eq!(
            text,
            "{\"type\":\"FeatureCollection\",\"features\":[\n\
             {\"type\":\"Feature\",\"properties\":{\"source\":\"a \\\"b\\\"\\u000a\"},\"geometry\":{\"type\":\"LineString\",\
             \"coordinates\":[[16.000000000,48.250000000],[16.000000000,48.500000000]]}},\n\
             {\"type\":\"Feature\",\"properties\":{\"keyframe\":3,\"time_s\":0.5},\"geometry\":{\"type\":\"Point\",\
             \"coordinates\":[16.000000000,48.250000000]}}\n]}\n"
        );
    }
}
