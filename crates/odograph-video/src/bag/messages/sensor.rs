//! Sensors beside the camera: `sensor_msgs/Imu`, `nav_msgs/Odometry`, `sensor_msgs/Range`,
//! `sensor_msgs/NavSatFix`.

use super::Role;
use crate::bag::cursor::MessageCursor;
use crate::bag::recording::Topic;
use nalgebra::Matrix2;
use odograph::filter::fusion::Quantity;
use odograph::geometry::EarthPosition;
use odograph::georeference::GnssFix;

/// The quantity that is taken from a topic; `None` if it is not of a sensor.
pub(crate) fn quantity(role: Role) -> Option<Quantity> {
    match role {
        Role::Gyro => Some(Quantity::TurnRates),
        Role::Wheel => Some(Quantity::Speed),
        Role::Range => Some(Quantity::AxisDistance),
        _ => None,
    }
}

/// The values of a message: one for each channel of its quantity; `None` if it is cut off or has
/// none, as a range finder that sees nothing.
pub(crate) fn values(topic: &Topic, data: &[u8]) -> Option<Vec<f64>> {
    let mut message = MessageCursor::new(data, &topic.serialization)?;
    message.header()?;
    let values = match Role::of(topic) {
        Role::Gyro => {
            let _orientation_and_covariance: [f64; 13] = message.doubles()?;
            message.doubles::<3>()?.to_vec()
        }
        Role::Wheel => {
            message.string()?;
            let _pose_and_covariance: [f64; 43] = message.doubles()?;
            message.doubles::<1>()?.to_vec()
        }
        Role::Range => {
            // Kind of radiation and field of view.
            message.u8()?;
            message.f32()?;
            let (least, most, range) = (message.f32()?, message.f32()?, message.f32()?);
            if !(least..=most).contains(&range) {
                return None;
            }
            vec![f64::from(range)]
        }
        _ => return None,
    };
    values.iter().all(|value| value.is_finite()).then_some(values)
}

/// Position, altitude above the ellipsoid, and covariance of east and north of a
/// `sensor_msgs/NavSatFix`; `None` if it is cut off or has no position.
pub(crate) fn position(topic: &Topic, data: &[u8]) -> Option<(EarthPosition, Option<f64>, Matrix2<f64>)> {
    let mut message = MessageCursor::new(data, &topic.serialization)?;
    message.header()?;
    // Negative: no fix.
    let has_fix = message.u8()? as i8 >= 0;
    let _service = message.u16()?;
    let [latitude_deg, longitude_deg, altitude_m] = message.doubles()?;
    let covariance: [f64; 9] = message.doubles()?;
    let is_known = message.u8()? != 0;
    let place = EarthPosition::from_degrees(latitude_deg, longitude_deg).filter(|_| has_fix)?;
    let stated = Matrix2::new(covariance[0], covariance[1], covariance[3], covariance[4]);
    let usual = GnssFix::covariance_m2(GnssFix::USUAL_SIGMA_M, GnssFix::USUAL_SIGMA_M);
    let is_possible = stated.iter().all(|value| value.is_finite()) && stated.cholesky().is_some();
    let covariance_m2 = match is_known && is_possible {
        true => {
            let [east_m, north_m] = [stated[(0, 0)].sqrt(), stated[(1, 1)].sqrt()];
            let in_range = GnssFix::SIGMAS_M.contains(&east_m) && GnssFix::SIGMAS_M.contains(&north_m);
            if in_range { stated } else { GnssFix::covariance_m2(east_m, north_m) }
        }
        false => usual,
    };
    Some((place, Some(altitude_m).filter(|altitude_m| altitude_m.is_finite()), covariance_m2))
}
