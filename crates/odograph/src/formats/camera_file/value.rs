//! YAML parsed to a tree of plain values, with bounded size and depth.

use crate::error::{Error, Result};
use serde::de::{Deserialize, Deserializer, MapAccess, SeqAccess, Visitor};
use serde_saphyr::options::NonFiniteFloatPolicy;
use std::fmt;

/// Largest accepted file size, bytes. Camera files are small; even one with every board corner of a
/// long calibration is below this.
const MAX_BYTES: usize = 16 << 20;

/// Error message of the parser, for users who do not know the parser.
fn sentence(error: &serde_saphyr::Error) -> String {
    use serde_saphyr::Error::{Budget, DuplicateMappingKey, MultipleDocuments};
    let line = error.location().map_or_else(String::new, |location| format!(" (line {})", location.line()));
    match error.without_snippet() {
        DuplicateMappingKey { key: Some(key), .. } => {
            format!("the camera file holds the key `{}` twice{line}; keep one of them", shown(key))
        }
        MultipleDocuments { .. } => {
            format!("the camera file holds several YAML documents{line}; keep the one with the camera")
        }
        // That of aliases is a message within another error.
        other if matches!(other, Budget { .. }) || other.to_string().contains("budget breached") => {
            format!(
                "the camera file is larger or nested deeper than any calibration{line}; is this the right file?"
            )
        }
        // Collapses a message of several lines to one.
        other => {
            let message = other.to_string().split_whitespace().collect::<Vec<_>>().join(" ");
            format!(
                "the camera file is not readable as YAML: {}",
                message.chars().take(300).collect::<String>()
            )
        }
    }
}

/// The first characters of a text, for an error message.
fn shown(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).take(40).collect()
}

/// A node of the YAML tree.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Value {
    Nothing,
    Truth(bool),
    Number(f64),
    Text(String),
    List(Vec<Value>),
    Map(Vec<(String, Value)>),
}

impl Value {
    /// Parses YAML (of which JSON is a subset).
    pub(super) fn parse(text: &str) -> Result<Self> {
        if text.len() > MAX_BYTES {
            return Err(Error::input(format!(
                "the camera file has {} bytes, more than any calibration; is this the right file?",
                text.len()
            )));
        }
        let options = serde_saphyr::options! {
            budget: serde_saphyr::budget! { max_depth: 32, flow_nesting_limit: 32, max_aliases: 64, max_anchors: 64 },
            non_finite_float_policy: NonFiniteFloatPolicy::PassThrough,
            with_snippet: false,
        };
        serde_saphyr::from_str_with_options(text, options).map_err(|error| Error::input(sentence(&error)))
    }

    /// Value of a key; `None` if the node is not a map or has no such key.
    pub(super) fn get(&self, key: &str) -> Option<&Value> {
        match self {
            Self::Map(entries) => entries.iter().find(|(name, _)| name == key).map(|(_, value)| value),
            _ => None,
        }
    }

    /// The first of several spellings of a key that is present, with its value.
    pub(super) fn first_of<'a>(&self, keys: &[&'a str]) -> Option<(&'a str, &Value)> {
        keys.iter().find_map(|key| self.get(key).map(|value| (*key, value)))
    }

    /// A finite number; `name` is its name in the error message.
    pub(super) fn number(&self, name: &str) -> Result<f64> {
        match self {
            Self::Number(number) if number.is_finite() => Ok(*number),
            other => Err(Error::input(format!("{name} is {other}; it must be a finite number"))),
        }
    }

    /// An image size: a positive integer, pixels.
    pub(super) fn pixels(&self, name: &str) -> Result<usize> {
        let number = self.number(name)?;
        if number.fract() == 0.0 && (1.0..=65_536.0).contains(&number) {
            return Ok(number as usize);
        }
        Err(Error::input(format!("{name} is {number}; it must be a whole number of pixels from 1 to 65536")))
    }

    /// The numbers of a list, a list of lists, or a matrix with `rows`, `cols` and `data`, in
    /// row-major order.
    pub(super) fn numbers(&self, name: &str) -> Result<Vec<f64>> {
        match self {
            Self::List(items) => {
                let mut numbers = Vec::with_capacity(items.len());
                for (index, item) in items.iter().enumerate() {
                    let place = format!("{name}[{index}]");
                    match item {
                        Self::List(_) => numbers.extend(item.numbers(&place)?),
                        _ => numbers.push(item.number(&place)?),
                    }
                }
                Ok(numbers)
            }
            Self::Map(_) => {
                let data = self.get("data").ok_or_else(|| {
                    Error::input(format!("{name} has no `data`; a matrix has `rows`, `cols` and `data`"))
                })?;
                let numbers = data.numbers(&format!("{name}.data"))?;
                if let (Some(rows), Some(cols)) = (self.get("rows"), self.get("cols")) {
                    let rows = rows.number(&format!("{name}.rows"))?;
                    let cols = cols.number(&format!("{name}.cols"))?;
                    if rows * cols != numbers.len() as f64 {
                        return Err(Error::input(format!(
                            "{name} says it has {rows} x {cols} numbers, but its data has {}",
                            numbers.len()
                        )));
                    }
                }
                Ok(numbers)
            }
            other => Err(Error::input(format!("{name} is {other}; it must be a list of numbers"))),
        }
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Nothing => f.write_str("empty"),
            Self::Truth(truth) => write!(f, "{truth}"),
            Self::Number(number) => write!(f, "{number}"),
            Self::Text(text) => write!(f, "the text {:?}", shown(text)),
            Self::List(items) => write!(f, "a list of {}", items.len()),
            Self::Map(_) => f.write_str("a map of keys"),
        }
    }
}

impl<'de> Deserialize<'de> for Value {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        deserializer.deserialize_any(TreeVisitor)
    }
}

struct TreeVisitor;

impl<'de> Visitor<'de> for TreeVisitor {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number, a text, a list or a map")
    }

    fn visit_bool<E>(self, truth: bool) -> std::result::Result<Value, E> {
        Ok(Value::Truth(truth))
    }

    fn visit_i64<E>(self, number: i64) -> std::result::Result<Value, E> {
        Ok(Value::Number(number as f64))
    }

    fn visit_u64<E>(self, number: u64) -> std::result::Result<Value, E> {
        Ok(Value::Number(number as f64))
    }

    fn visit_i128<E>(self, number: i128) -> std::result::Result<Value, E> {
        Ok(Value::Number(number as f64))
    }

    fn visit_u128<E>(self, number: u128) -> std::result::Result<Value, E> {
        Ok(Value::Number(number as f64))
    }

    fn visit_f64<E>(self, number: f64) -> std::result::Result<Value, E> {
        Ok(Value::Number(number))
    }

    fn visit_str<E>(self, text: &str) -> std::result::Result<Value, E> {
        Ok(Value::Text(text.to_owned()))
    }

    fn visit_unit<E>(self) -> std::result::Result<Value, E> {
        Ok(Value::Nothing)
    }

    fn visit_none<E>(self) -> std::result::Result<Value, E> {
        Ok(Value::Nothing)
    }

    fn visit_some<D: Deserializer<'de>>(self, deserializer: D) -> std::result::Result<Value, D::Error> {
        Value::deserialize(deserializer)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> std::result::Result<Value, A::Error> {
        let mut items = Vec::new();
        while let Some(item) = list.next_element()? {
            items.push(item);
        }
        Ok(Value::List(items))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<Value, A::Error> {
        let mut entries = Vec::new();
        while let Some(entry) = map.next_entry()? {
            entries.push(entry);
        }
        Ok(Value::Map(entries))
    }
}
