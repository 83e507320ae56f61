//! The commands that are killed, and what they work on.

use crate::program::Program;
use odograph::error::{Error, Result};
use odograph_map::MapFile;
use std::fs;
use std::path::{Path, PathBuf};

/// Side of the square path, metres: nine keyframes.
const DRIVE: &str =
    "--format y4m --size 192x144 --path square --length 0.6 --speed 0.8 --height 0.5 --fps 20 --seed 1 -q";

/// Two recordings of the same ground, and maps of them.
#[derive(Debug)]
pub struct Inputs {
    folder: PathBuf,
}

impl Inputs {
    /// Renders the recordings and follows them.
    pub fn prepare(program: &Program, folder: &Path) -> Result<Self> {
        let inputs = Self { folder: folder.join("inputs") };
        fs::create_dir(&inputs.folder).map_err(|error| Error::output(error.to_string()))?;
        let run = |arguments: &str| {
            let done = program.run(&inputs.folder, arguments)?;
            match done.status.success() {
                true => Ok(()),
                false => Err(Error::input(String::from_utf8_lossy(&done.stderr).into_owned())),
            }
        };
        for (name, noise) in [("monday", 1), ("tuesday", 2)] {
            run(&format!("simulate -o {name} {DRIVE} --noise {noise}"))?;
            let mount = format!("--camera {name}/camera.yaml --rig {name}/rig.toml");
            run(&format!("run {name}/sim.y4m {mount} -o {name}-run -q --robot {name}"))?;
        }
        run("map merge monday-run/map.gpkg tuesday-run/map.gpkg -o hall.gpkg -q")?;
        // Keyframes away from where the measurements put them, so that optimising moves them.
        let bent = inputs.path("bent.gpkg");
        fs::copy(inputs.path("hall.gpkg"), &bent).map_err(|error| Error::output(error.to_string()))?;
        let mut map = MapFile::open(&bent)?;
        let mut poses: Vec<_> = map.map()?.keyframes.iter().map(|k| (k.id, k.pose, k.covariance)).collect();
        for (number, (_, pose, _)) in poses.iter_mut().enumerate() {
            pose.x_m += 0.01 * (number as f64).sin();
        }
        map.set_poses(&poses)?;
        map.close()?;
        Ok(inputs)
    }

    /// A file among the inputs.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// The folder of all trials.
    pub fn trials(&self) -> PathBuf {
        self.folder.with_file_name("trial")
    }
}

/// What a map must hold after a command was killed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Keyframes {
    /// All that were there before, and maybe more.
    Grow,
    /// Those before or those after the command, never anything between.
    BeforeOrAfter,
}

/// A command to be killed. In its arguments `IN` is the folder of the inputs.
#[derive(Debug)]
pub struct Victim {
    pub name: &'static str,
    pub arguments: &'static str,
    /// What runs beside it and is not killed: a robot that sends to a site. A site ends after it.
    pub client: Option<&'static str>,
    /// How it is run again; `None`: in the same way.
    pub again: Option<&'static str>,
    /// Inputs copied into its folder first, each under a new name.
    pub copies: &'static [(&'static str, &'static str)],
    /// The map that it writes.
    pub map: &'static str,
    pub keyframes: Keyframes,
    /// Whether it is a run, which leaves its frames in `out`.
    pub is_run: bool,
}

const FOLLOW: &str =
    "run IN/monday/sim.y4m --camera IN/monday/camera.yaml --rig IN/monday/rig.toml -q -o out";
const FOLLOW_AGAIN: &str =
    "run IN/monday/sim.y4m --camera IN/monday/camera.yaml --rig IN/monday/rig.toml -q -o out --force";

/// All commands.
pub fn victims() -> Vec<Victim> {
    let run = Victim {
        name: "run",
        arguments: FOLLOW,
        client: None,
        again: Some(FOLLOW_AGAIN),
        copies: &[],
        map: "out/map.gpkg",
        keyframes: Keyframes::Grow,
        is_run: true,
    };
    let map = Victim {
        name: "map optimize",
        arguments: "map optimize hall.gpkg -q",
        client: None,
        again: None,
        copies: &[("bent.gpkg", "hall.gpkg")],
        map: "hall.gpkg",
        keyframes: Keyframes::BeforeOrAfter,
        is_run: false,
    };
    vec![
        Victim {
            name: "run --map",
            arguments: "run IN/tuesday/sim.y4m --camera IN/tuesday/camera.yaml --rig IN/tuesday/rig.toml -q -o out \
                        --map hall.gpkg",
            again: Some(
                "run IN/tuesday/sim.y4m --camera IN/tuesday/camera.yaml --rig IN/tuesday/rig.toml -q -o again \
                 --map hall.gpkg",
            ),
            copies: &[("monday-run/map.gpkg", "hall.gpkg")],
            map: "hall.gpkg",
            ..run
        },
        Victim {
            name: "run --map (new)",
            arguments: "run IN/monday/sim.y4m --camera IN/monday/camera.yaml --rig IN/monday/rig.toml -q -o out \
                        --map new.gpkg",
            again: Some(
                "run IN/monday/sim.y4m --camera IN/monday/camera.yaml --rig IN/monday/rig.toml -q -o again \
                 --map new.gpkg",
            ),
            map: "new.gpkg",
            ..run
        },
        Victim {
            name: "live",
            arguments: "live IN/monday/sim.y4m --camera IN/monday/camera.yaml --rig IN/monday/rig.toml -q -o out \
                        --realtime 20",
            again: Some(
                "live IN/monday/sim.y4m --camera IN/monday/camera.yaml --rig IN/monday/rig.toml -q -o out \
                 --realtime 20 --force",
            ),
            ..run
        },
        Victim {
            name: "live --map",
            arguments: "live IN/tuesday/sim.y4m --camera IN/tuesday/camera.yaml --rig IN/tuesday/rig.toml -q -o out \
                        --realtime 20 --map hall.gpkg",
            again: Some(
                "live IN/tuesday/sim.y4m --camera IN/tuesday/camera.yaml --rig IN/tuesday/rig.toml -q -o again \
                 --realtime 20 --map hall.gpkg",
            ),
            copies: &[("monday-run/map.gpkg", "hall.gpkg")],
            map: "hall.gpkg",
            ..run
        },
        Victim {
            name: "localize --extend",
            arguments: "localize IN/tuesday/sim.y4m --map hall.gpkg --extend -q -o out",
            again: Some("localize IN/tuesday/sim.y4m --map hall.gpkg --extend -q -o again"),
            copies: &[("monday-run/map.gpkg", "hall.gpkg")],
            map: "hall.gpkg",
            ..run
        },
        Victim {
            name: "site serve",
            arguments: "site serve hall --listen 127.0.0.1:18137 -q",
            client: Some("site send IN/monday-run/map.gpkg --site http://127.0.0.1:18137/ --robot monday -q"),
            again: None,
            map: "hall/map.gpkg",
            is_run: false,
            ..run
        },
        run,
        Victim {
            name: "map merge",
            arguments: "map merge IN/monday-run/map.gpkg IN/tuesday-run/map.gpkg -o joined.gpkg -q --force",
            copies: &[("monday-run/map.gpkg", "joined.gpkg")],
            map: "joined.gpkg",
            ..map
        },
        Victim {
            name: "map thin",
            arguments: "map thin hall.gpkg --max-keyframes 6 -q",
            copies: &[("hall.gpkg", "hall.gpkg")],
            ..map
        },
        Victim { name: "map mosaic", arguments: "map mosaic hall.gpkg --resolution 3mm -q", ..map },
        map,
    ]
}
