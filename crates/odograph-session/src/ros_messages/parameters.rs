//! Requests, responses and events of parameters: `rcl_interfaces/srv/GetParameters`,
//! `GetParameterTypes`, `SetParameters`, `SetParametersAtomically`, `ListParameters` and
//! `DescribeParameters`.

use super::cdr::Cdr;
use odograph_video::MessageCursor;

/// The value of a parameter.
#[derive(Debug, Clone, PartialEq)]
pub enum ParameterValue {
    /// There is no such parameter.
    NotSet,
    /// True or false.
    Bool(bool),
    /// A whole number.
    Integer(i64),
    /// A number.
    Double(f64),
    /// A text.
    Text(String),
    /// An array, by the number of its type: this node has none.
    Array(u8),
}

impl ParameterValue {
    /// The number of its type, as `rcl_interfaces/msg/ParameterType` has it.
    pub fn type_number(&self) -> u8 {
        match self {
            Self::NotSet => 0,
            Self::Bool(_) => 1,
            Self::Integer(_) => 2,
            Self::Double(_) => 3,
            Self::Text(_) => 4,
            Self::Array(number) => *number,
        }
    }

    /// The name of its type in a sentence.
    pub fn type_name(&self) -> &'static str {
        match self {
            Self::NotSet => "nothing",
            Self::Bool(_) => "a bool",
            Self::Integer(_) => "an integer",
            Self::Double(_) => "a double",
            Self::Text(_) => "a string",
            Self::Array(_) => "an array",
        }
    }

    fn write(&self, message: &mut Cdr) {
        message.u8(self.type_number());
        message.bool(*self == Self::Bool(true));
        message.i64(if let Self::Integer(value) = self { *value } else { 0 });
        message.doubles([if let Self::Double(value) = self { *value } else { 0.0 }]);
        message.text(if let Self::Text(value) = self { value } else { "" });
        // Five kinds of arrays.
        (0..5).for_each(|_| message.u32(0));
    }

    fn read(message: &mut MessageCursor<'_>) -> Option<Self> {
        let number = message.u8()?;
        let truth = message.u8()? != 0;
        let (integer, double) = (message.u64()?.cast_signed(), message.f64()?);
        let text = message.string()?.into_owned();
        // Bytes, truth values, whole numbers, numbers and texts.
        message.bytes()?;
        message.bytes()?;
        for _ in 0..count(message)? {
            message.u64()?;
        }
        for _ in 0..count(message)? {
            message.u64()?;
        }
        for _ in 0..count(message)? {
            message.string()?;
        }
        Some(match number {
            0 => Self::NotSet,
            1 => Self::Bool(truth),
            2 => Self::Integer(integer),
            3 => Self::Double(double),
            4 => Self::Text(text),
            number => Self::Array(number),
        })
    }
}

/// A parameter, with what there is to say about it.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// Its name.
    pub name: String,
    /// Its value.
    pub value: ParameterValue,
    /// What it is, in a sentence.
    pub description: String,
    /// Whether it stays as it is during the run.
    pub is_read_only: bool,
}

fn count(message: &mut MessageCursor<'_>) -> Option<usize> {
    usize::try_from(message.u32()?).ok()
}

fn names(message: &mut MessageCursor<'_>) -> Option<Vec<String>> {
    (0..count(message)?).map(|_| Some(message.string()?.into_owned())).collect()
}

/// The names in a request of values, types or descriptions; `None` if it is damaged.
pub fn requested_names(request: &[u8]) -> Option<Vec<String>> {
    names(&mut MessageCursor::cdr(request)?)
}

/// The prefixes in a request for a list, and the number of levels of names below them, 0 for all;
/// `None` if it is damaged.
pub fn requested_prefixes(request: &[u8]) -> Option<(Vec<String>, u64)> {
    let mut message = MessageCursor::cdr(request)?;
    Some((names(&mut message)?, message.u64()?))
}

/// Names and new values in a request of changes; `None` if it is damaged.
pub fn requested_changes(request: &[u8]) -> Option<Vec<(String, ParameterValue)>> {
    let mut message = MessageCursor::cdr(request)?;
    let count = count(&mut message)?;
    (0..count).map(|_| Some((message.string()?.into_owned(), ParameterValue::read(&mut message)?))).collect()
}

fn sequence<T>(items: &[T], mut write: impl FnMut(&mut Cdr, &T)) -> Vec<u8> {
    let mut message = Cdr::new();
    message.u32(items.len() as u32);
    items.iter().for_each(|item| write(&mut message, item));
    message.finished()
}

/// Response of `GetParameters`.
pub fn parameter_values(values: &[ParameterValue]) -> Vec<u8> {
    sequence(values, |message, value| value.write(message))
}

/// Response of `GetParameterTypes`.
pub fn parameter_types(values: &[ParameterValue]) -> Vec<u8> {
    sequence(values, |message, value| message.u8(value.type_number()))
}

/// Response of `DescribeParameters`; a parameter that does not exist has no description.
pub fn parameter_descriptions(parameters: &[Parameter]) -> Vec<u8> {
    sequence(parameters, |message, parameter| {
        message.text(&parameter.name);
        message.u8(parameter.value.type_number());
        message.text(&parameter.description);
        message.text("");
        message.bool(parameter.is_read_only);
        message.bool(false);
        // Ranges of numbers.
        message.u32(0);
        message.u32(0);
    })
}

/// Response of `ListParameters`.
pub fn parameter_list(names: &[&str], prefixes: &[&str]) -> Vec<u8> {
    let mut message = Cdr::new();
    for list in [names, prefixes] {
        message.u32(list.len() as u32);
        list.iter().for_each(|name| message.text(name));
    }
    message.finished()
}

fn write_result(message: &mut Cdr, result: &Result<(), String>) {
    message.bool(result.is_ok());
    message.text(result.as_ref().err().map_or("", String::as_str));
}

/// Response of `SetParameters`: whether each was changed, or why not.
pub fn parameter_results(results: &[Result<(), String>]) -> Vec<u8> {
    sequence(results, write_result)
}

/// Response of `SetParametersAtomically`: whether all were changed, or why nothing was.
pub fn parameter_result(result: &Result<(), String>) -> Vec<u8> {
    let mut message = Cdr::new();
    write_result(&mut message, result);
    message.finished()
}

/// `rcl_interfaces/msg/ParameterEvent`: parameters of a node, by its full name, that have changed.
pub fn parameter_event(time_ns: u64, node: &str, changed: &[Parameter]) -> Vec<u8> {
    let mut message = Cdr::new();
    message.time(time_ns);
    message.text(node);
    // No new ones.
    message.u32(0);
    message.u32(changed.len() as u32);
    for parameter in changed {
        message.text(&parameter.name);
        parameter.value.write(&mut message);
    }
    // No deleted ones.
    message.u32(0);
    message.finished()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    #[test]
    fn values_are_read_as_they_are_written() {
        let values = [
            ("a", ParameterValue::Bool(true)),
            ("odd", ParameterValue::Integer(-7)),
            ("double", ParameterValue::Double(0.9)),
            ("text", ParameterValue::Text("dock".to_owned())),
            ("", ParameterValue::NotSet),
        ];
        let request = sequence(&values, |message, (name, value)| {
            message.text(name);
            value.write(message);
        });
        let expected = values.map(|(name, value)| (name.to_owned(), value));
        assert_eq!(requested_changes(&request).unwrap(), expected);
        // Cut off anywhere it is refused, and so is a number of items that no message holds.
        assert!((0..request.len()).all(|end| requested_changes(&request[..end]).is_none()));
        let mut many = request.clone();
        many[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(requested_changes(&many).is_none() && requested_names(&many).is_none());
    }

    #[test]
    fn names_and_prefixes_are_read() {
        let request = parameter_list(&["height", "camera_frame"], &[]);
        assert_eq!(requested_names(&request).unwrap(), ["height", "camera_frame"]);
        let mut message = Cdr::new();
        message.u32(1);
        message.text("qos");
        message.i64(2);
        assert_eq!(requested_prefixes(&message.finished()).unwrap(), (vec!["qos".to_owned()], 2));
        assert!(requested_prefixes(&request[..8]).is_none());
    }
}
