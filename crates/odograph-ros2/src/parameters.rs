//! The parameters of the node, as ROS 2 expects them.

use odograph_session::ros_messages::{self, Parameter, ParameterValue};

/// A call of one of the services of parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ParameterCall {
    Get,
    Types,
    Set,
    SetAtomically,
    List,
    Describe,
}

impl ParameterCall {
    pub const ALL: [Self; 6] =
        [Self::Get, Self::Types, Self::Set, Self::SetAtomically, Self::List, Self::Describe];

    /// Name of the service below that of the node, and its type.
    pub fn service(self) -> (&'static str, &'static str) {
        match self {
            Self::Get => ("get_parameters", "rcl_interfaces/srv/GetParameters"),
            Self::Types => ("get_parameter_types", "rcl_interfaces/srv/GetParameterTypes"),
            Self::Set => ("set_parameters", "rcl_interfaces/srv/SetParameters"),
            Self::SetAtomically => {
                ("set_parameters_atomically", "rcl_interfaces/srv/SetParametersAtomically")
            }
            Self::List => ("list_parameters", "rcl_interfaces/srv/ListParameters"),
            Self::Describe => ("describe_parameters", "rcl_interfaces/srv/DescribeParameters"),
        }
    }
}

/// The parameters of a node.
#[derive(Debug, Default)]
pub struct Parameters(Vec<Parameter>);

impl Parameters {
    /// Adds a parameter, or changes what there is of it.
    pub fn put(&mut self, name: &str, value: ParameterValue, is_read_only: bool, description: &str) {
        self.0.retain(|parameter| parameter.name != name);
        let at = self.0.partition_point(|parameter| parameter.name.as_str() < name);
        let (name, description) = (name.to_owned(), description.to_owned());
        self.0.insert(at, Parameter { name, value, description, is_read_only });
    }

    fn find(&self, name: &str) -> Option<&Parameter> {
        self.0.iter().find(|parameter| parameter.name == name)
    }

    /// The value of a parameter.
    pub fn value(&self, name: &str) -> ParameterValue {
        self.find(name).map_or(ParameterValue::NotSet, |parameter| parameter.value.clone())
    }

    /// The response to a call, and which parameters it has changed. `None` if the request is
    /// damaged.
    pub fn answer(&mut self, call: ParameterCall, request: &[u8]) -> Option<(Vec<u8>, Vec<Parameter>)> {
        let mut changed = Vec::new();
        let response = match call {
            ParameterCall::Get | ParameterCall::Types => {
                let names = ros_messages::requested_names(request)?;
                let values: Vec<_> = names.iter().map(|name| self.value(name)).collect();
                match call {
                    ParameterCall::Get => ros_messages::parameter_values(&values),
                    _ => ros_messages::parameter_types(&values),
                }
            }
            ParameterCall::Describe => {
                let names = ros_messages::requested_names(request)?;
                let described = names.into_iter().map(|name| match self.find(&name) {
                    Some(parameter) => parameter.clone(),
                    None => Parameter {
                        name,
                        value: ParameterValue::NotSet,
                        description: String::new(),
                        is_read_only: false,
                    },
                });
                ros_messages::parameter_descriptions(&described.collect::<Vec<_>>())
            }
            ParameterCall::List => {
                let (prefixes, levels) = ros_messages::requested_prefixes(request)?;
                ros_messages::parameter_list(&self.names(&prefixes, levels), &[])
            }
            ParameterCall::Set => {
                let changes = ros_messages::requested_changes(request)?;
                let results = changes.into_iter().map(|(name, value)| {
                    self.check(&name, &value)?;
                    changed.extend(self.set(&name, value));
                    Ok(())
                });
                let results: Vec<Result<(), String>> = results.collect();
                ros_messages::parameter_results(&results)
            }
            ParameterCall::SetAtomically => {
                let changes = ros_messages::requested_changes(request)?;
                let result = changes.iter().try_for_each(|(name, value)| self.check(name, value));
                if result.is_ok() {
                    changed.extend(changes.into_iter().filter_map(|(name, value)| self.set(&name, value)));
                }
                ros_messages::parameter_result(&result)
            }
        };
        Some((response, changed))
    }

    /// The names at or below the prefixes, or all names if there is no prefix. Levels are the words
    /// between dots; `levels` is the largest number of them below a prefix, 0 for any number.
    fn names(&self, prefixes: &[String], levels: u64) -> Vec<&str> {
        let is_near = |below: &str| levels == 0 || (below.matches('.').count() as u64) < levels;
        let is_wanted = |name: &str| {
            let below = |prefix: &String| match name.strip_prefix(prefix.as_str()) {
                Some("") => true,
                Some(below) => below.strip_prefix('.').is_some_and(is_near),
                None => false,
            };
            if prefixes.is_empty() { is_near(name) } else { prefixes.iter().any(below) }
        };
        self.0.iter().map(|parameter| parameter.name.as_str()).filter(|name| is_wanted(name)).collect()
    }

    /// Whether a parameter may have a value, or why not, in a sentence.
    fn check(&self, name: &str, value: &ParameterValue) -> Result<(), String> {
        let Some(known) = self.find(name) else {
            return Err(format!("there is no parameter {name}; ros2 param list shows those there are"));
        };
        if known.is_read_only {
            return Err(format!("{name} is read-only: {}", known.description));
        }
        if known.value.type_number() != value.type_number() {
            let (expected, given) = (known.value.type_name(), value.type_name());
            return Err(format!("{name} is {expected}, not {given}"));
        }
        Ok(())
    }

    fn set(&mut self, name: &str, value: ParameterValue) -> Option<Parameter> {
        let parameter = self.0.iter_mut().find(|parameter| parameter.name == name)?;
        parameter.value = value;
        Some(parameter.clone())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    fn parameters() -> Parameters {
        let mut parameters = Parameters::default();
        parameters.put("qos.depth", ParameterValue::Integer(4), true, "");
        parameters.put("publish_odom_tf", ParameterValue::Bool(true), false, "");
        parameters.put("height", ParameterValue::Double(0.9), true, "given when the run begins");
        parameters.put("qos.images.depth", ParameterValue::Integer(4), true, "");
        parameters
    }

    #[test]
    fn names_are_listed_by_prefix_and_depth() {
        let parameters = parameters();
        let names = |prefixes: &[&str], levels| {
            parameters.names(&prefixes.iter().map(ToString::to_string).collect::<Vec<_>>(), levels)
        };
        assert_eq!(names(&[], 0), ["height", "publish_odom_tf", "qos.depth", "qos.images.depth"]);
        assert_eq!(names(&[], 1), ["height", "publish_odom_tf"]);
        assert_eq!(names(&["qos"], 1), ["qos.depth"]);
        assert_eq!(names(&["qos", "height"], 0), ["height", "qos.depth", "qos.images.depth"]);
        assert!(names(&["q", "heights"], 0).is_empty());
    }

    #[test]
    fn only_what_may_change_is_changed() {
        let mut parameters = parameters();
        assert_eq!(
            parameters.check("height", &ParameterValue::Double(1.0)).unwrap_err(),
            "height is read-only: given when the run begins"
        );
        assert!(
            parameters
                .check("depth", &ParameterValue::Integer(1))
                .unwrap_err()
                .contains("no parameter depth")
        );
        assert_eq!(
            parameters.check("publish_odom_tf", &ParameterValue::Text(String::new())).unwrap_err(),
            "publish_odom_tf is a bool, not a string"
        );
        assert!(parameters.check("publish_odom_tf", &ParameterValue::Bool(false)).is_ok());
        assert!(parameters.set("publish_odom_tf", ParameterValue::Bool(false)).is_some());
        assert_eq!(parameters.value("publish_odom_tf"), ParameterValue::Bool(false));
        assert!(parameters.answer(ParameterCall::Get, &[0, 1, 0, 0, 9, 0, 0, 0]).is_none());
    }
}
