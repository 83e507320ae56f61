//! Command-line options of markers on the ground.

use odograph_session::RunBuilder;
use std::path::PathBuf;

/// The markers that are looked for, and where they were surveyed.
#[derive(Debug, Clone, Default, clap::Args)]
#[command(next_help_heading = "Estimation")]
pub struct MarkerArguments {
    /// Markers on the ground: family, dictionary and side of the black square.
    ///
    /// apriltag:36h11:80mm, or aruco:4x4_50:80mm and other dictionaries. A marker that is seen
    /// again closes a loop, exactly and without confusing places.
    #[arg(long, value_name = "FAMILY:SIZE")]
    pub markers: Option<String>,
    /// Surveyed places of markers (CSV: marker, x_m, y_m; sigma_m, heading_deg).
    ///
    /// Path and map are then in their frame and their metres: a wrong height is corrected, and a
    /// wrong line is left out and named.
    #[arg(long, value_name = "FILE", requires = "markers")]
    pub control: Option<PathBuf>,
}

impl MarkerArguments {
    /// The run that looks for them.
    pub fn of_run(&self, run: RunBuilder) -> RunBuilder {
        let run = self.markers.iter().fold(run, RunBuilder::markers);
        self.control.iter().fold(run, RunBuilder::control)
    }
}
