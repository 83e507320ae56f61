//! Sensors beside the camera: `sensor_msgs/Imu`, `nav_msgs/Odometry`, `sensor_msgs/Range`.

use super::Role;
use crate::bag::cursor::MessageCursor;
use crate::bag::recording::Topic;
use odograph::filter::fusion::Quantity;

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
