//! Export of clips for other programs, in the format of `odograph simulate --format y4m`.

use crate::arguments::GateArguments;
use crate::clip::Clip;
use crate::rendering::render;
use odograph::error::{Error, Result};
use odograph::formats::{camera_file, rig_file, trajectory_file};
use std::io::{BufWriter, Write};
use std::path::Path;

/// Writes the clips of the selected rows, each into `folder/ROW-SEED`.
pub fn export(arguments: &GateArguments, folder: &Path) -> Result<()> {
    for row in arguments.rows() {
        let seeds = arguments.seeds.unwrap_or(row.seeds);
        for seed in arguments.first_seed..arguments.first_seed + seeds {
            let to = folder.join(format!("{}-{seed}", row.name));
            let clip = render(&row, seed)?;
            write(&clip, &to).map_err(|error| Error::output(format!("{}: {error}", to.display())))?;
            println!("{}", to.display());
        }
    }
    Ok(())
}

fn write(clip: &Clip, folder: &Path) -> std::io::Result<()> {
    std::fs::create_dir_all(folder)?;
    std::fs::write(folder.join("camera.yaml"), camera_file::write(&clip.camera))?;
    std::fs::write(folder.join("rig.toml"), rig_file::write(&clip.rig))?;
    std::fs::write(folder.join("truth.tum"), trajectory_file::write_tum(&clip.truth))?;
    let (width, height, fps) = (clip.camera.width(), clip.camera.height(), clip.fps.round());
    let mut file = BufWriter::new(std::fs::File::create(folder.join("sim.y4m"))?);
    writeln!(file, "YUV4MPEG2 W{width} H{height} F{fps}:1 Ip A1:1 Cmono XCOLORRANGE=FULL")?;
    // Y4M has a constant frame rate; the timestamps of dropped and late frames are in a separate
    // file.
    let mut times = String::new();
    for (time_s, image) in &clip.frames {
        file.write_all(b"FRAME\n")?;
        file.write_all(image.samples())?;
        times += &format!("{time_s:.9}\n");
    }
    file.flush()?;
    std::fs::write(folder.join("times.txt"), times)
}
