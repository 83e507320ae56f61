//! Trajectories whose first line names the columns, as EuRoC's ground truth does.

/// Where the numbers of a pose stand in a line.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedColumns {
    /// Columns of `time x y z qx qy qz qw`, from 0.
    pub pose: [usize; 8],
    /// Number of columns.
    pub count: usize,
    /// Unit of the times, seconds.
    pub time_unit_s: f64,
}

const NANOSECOND_S: f64 = 1e-9;

impl NamedColumns {
    /// The columns by the comments before the first pose; `None` where these do not name all of a
    /// pose, or name what TUM's format has without them.
    pub fn of(text: &str) -> Option<Self> {
        let lines = text.trim_start_matches('\u{feff}').lines().map(str::trim);
        let comments = lines.take_while(|line| line.is_empty() || line.starts_with('#'));
        comments.map(|line| line.trim_start_matches('#')).find_map(Self::in_header)
    }

    fn in_header(header: &str) -> Option<Self> {
        let header = header.to_ascii_lowercase();
        // A unit may follow a name: `p_RS_R_x [m]`, `timestamp[ns]`.
        let name = |column: &str| column.split(['[', ' ', '\t']).next().unwrap_or_default().to_owned();
        let names: Vec<String> = match header.contains(',') {
            true => header.split(',').map(|column| name(column.trim())).collect(),
            false => header.split_whitespace().filter(|word| !word.starts_with('[')).map(name).collect(),
        };
        let find = |is: &dyn Fn(&str) -> bool| names.iter().position(|name| is(name));
        let position = |axis: char| {
            find(&|name| match name.strip_suffix(axis) {
                Some("" | "t" | "p") => true,
                Some(before) => {
                    (before.starts_with("p_") || before.starts_with("t_")) && before.ends_with('_')
                }
                None => false,
            })
        };
        let rotation = |part: char| {
            find(&|name| match name.strip_suffix(part) {
                Some("q") => true,
                Some(before) => before.starts_with("q_") && before.ends_with('_'),
                None => false,
            })
        };
        let time = find(&|name| matches!(name, "time" | "timestamp"))?;
        let pose = [
            time,
            position('x')?,
            position('y')?,
            position('z')?,
            rotation('x')?,
            rotation('y')?,
            rotation('z')?,
            rotation('w')?,
        ];
        // EuRoC's times are nanoseconds, also where its header does not say so.
        let is_nanoseconds = header.contains("[ns]") || names.iter().any(|name| name.starts_with("p_rs_r_"));
        let time_unit_s = if is_nanoseconds { NANOSECOND_S } else { 1.0 };
        let is_usual = pose == [0, 1, 2, 3, 4, 5, 6, 7] && !is_nanoseconds;
        (!is_usual).then_some(Self { pose, count: names.len(), time_unit_s })
    }
}
