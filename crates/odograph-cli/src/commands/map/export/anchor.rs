//! Where on Earth a map is, as it is given on the command line.

use odograph::error::{Error, Result};
use odograph::geometry::EarthPosition;
use odograph::georeference::Anchor;
use std::str::FromStr;

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
            EarthPosition::from_degrees(latitude, longitude).ok_or_else(|| {
                format!(
                    "latitude {latitude}, longitude {longitude} is no place that a map can be at; give degrees, latitude first"
                )
            })
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

/// The anchor that the arguments give; `None` if there are none.
pub fn anchor_of(arguments: &[AnchorArgument]) -> Result<Option<Anchor>> {
    match *arguments {
        [] => Ok(None),
        [AnchorArgument::Start(origin, heading_rad)] => Ok(Some(Anchor::at(origin, heading_rad))),
        [AnchorArgument::Point(a, there), AnchorArgument::Point(b, other)] => {
            Anchor::through([(a, there), (b, other)]).map(Some)
        }
        _ => Err(Error::usage("give --anchor once as LAT,LON,HEADING, or twice as X,Y=LAT,LON")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn anchor(texts: &[&str]) -> Result<Option<Anchor>> {
        anchor_of(&texts.iter().map(|text| text.parse().unwrap()).collect::<Vec<_>>())
    }

    #[test]
    fn a_heading_or_two_points_give_the_place() {
        let start = anchor(&["48.2082,16.3738,93.5"]).unwrap().unwrap();
        assert_eq!(start.utm_code(), 32_633);
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
    }

    #[test]
    fn what_is_no_anchor_is_refused() {
        for text in ["", "48.2", "48.2,16.3", "91,16,0", "1,2=3", "a,b,c", "nan,1,2"] {
            assert!(text.parse::<AnchorArgument>().is_err(), "{text:?}");
        }
        assert!(anchor(&["0,0=48,16", "1,0=48,17"]).is_err(), "a metre is no 74 km");
        assert!(anchor(&["0,0=48,16"]).is_err());
        assert!(anchor(&[]).unwrap().is_none());
    }
}
