//! Rendered rows of the world as it is: rolling shutters, uneven ground, parts of the robot in the
//! image, wind, lossy video and image processing. They are too many for the gate; they are measured
//! over several seeds beside `bench/opencv_reference.py`.

use crate::alterations::Alteration;
use crate::rows::{BenchmarkRow, ahead, eight, with};
use odograph_simulation::{
    Breathing, Bumper, Dirt, Effects, ExposureJumps, Kerb, Lamp, Relief, Shadow, SlowVariation, Sway,
    Terrain, Undulation, Vibration,
};

/// All rows of the field.
pub fn rows() -> Vec<BenchmarkRow> {
    let noise = || Effects { noise_gray: 2.0, ..Effects::default() };
    let rolling = |readout_s| Effects { readout_s, ..noise() };
    let shaking = Vibration { shift_m: 0.002, turn_rad: 0.005, frequency_hz: 10.0 };
    let hand = |readout_s: f64| Effects {
        vibration: Some(Vibration { shift_m: 0.006, turn_rad: 0.012, frequency_hz: 4.0 }),
        height_change: Some(SlowVariation { amplitude: 0.1, period_s: 5.0 }),
        tilt_change: Some(SlowVariation { amplitude: 3f64.to_radians(), period_s: 4.0 }),
        exposure_s: 0.004,
        ..rolling(readout_s)
    };
    let phone = Effects { exposure_jumps: Some(ExposureJumps { amount: 0.3, every_s: 1.5 }), ..hand(0.020) };
    let on = |terrain| Effects { terrain, ..noise() };
    let gravel = |amplitude_m| {
        on(Terrain { relief: Some(Relief { amplitude_m, scale_m: 0.05 }), ..Terrain::default() })
    };
    let undulating = |ride| {
        let undulation = Some(Undulation { amplitude_m: 0.03, wavelength_m: 2.0 });
        on(Terrain { undulation, ride, ..Terrain::default() })
    };
    let kerb = on(Terrain { kerb: Some(Kerb { height_m: 0.05, at_m: 2.0 }), ..Terrain::default() });
    let wind =
        |amplitude_m| Effects { sway: Some(Sway { amplitude_m, share: 0.5, period_s: 1.3 }), ..noise() };
    let strong = Vibration { shift_m: 0.006, turn_rad: 0.015, frequency_hz: 8.0 };
    let concrete = |name, effects| BenchmarkRow { texture: "concrete", ..with(name, effects) };
    let straight = |name, effects| BenchmarkRow { path: ahead, ..with(name, effects) };
    let figure = |name, effects| BenchmarkRow { path: eight, ..with(name, effects) };
    let altered = |name, alteration| BenchmarkRow { alteration: Some(alteration), ..with(name, noise()) };
    let concrete_altered =
        |name, alteration| BenchmarkRow { texture: "concrete", ..altered(name, alteration) };
    vec![
        BenchmarkRow { speed_m_s: 0.5, ..straight("roll10", rolling(0.010)) },
        BenchmarkRow { speed_m_s: 0.5, ..straight("roll30", rolling(0.030)) },
        BenchmarkRow { speed_m_s: 1.0, ..straight("roll20-fast", rolling(0.020)) },
        figure("roll10-eight", rolling(0.010)),
        figure("roll30-eight", rolling(0.030)),
        with("roll20-shaken", Effects { vibration: Some(shaking), ..rolling(0.020) }),
        BenchmarkRow { texture: "grass", ..with("roll20-hand", hand(0.020)) },
        BenchmarkRow { texture: "grass", h264_qp: Some(30), ..with("phone", phone) },
        with("gravel5", gravel(0.005)),
        with("gravel15", gravel(0.015)),
        with("undulation-level", undulating(false)),
        with("undulation-riding", undulating(true)),
        figure("undulation-eight", undulating(true)),
        straight("step", kerb),
        concrete("bumper5", Effects { bumper: Some(Bumper { share: 0.05 }), ..noise() }),
        concrete("bumper25", Effects { bumper: Some(Bumper { share: 0.25 }), ..noise() }),
        concrete("specks", Effects { dirt: Some(Dirt { count: 30 }), ..noise() }),
        concrete("shadow", Effects { carrier_shadow: Some(Shadow::default()), ..noise() }),
        concrete("lamp", Effects { lamp: Some(Lamp::default()), ..noise() }),
        BenchmarkRow { texture: "grass", ..with("wind", wind(0.009)) },
        with("blur33-shaken", Effects { vibration: Some(strong), exposure_s: 0.033, ..noise() }),
        with("breathing", Effects { breathing: Some(Breathing { share: 0.005, period_s: 3.0 }), ..noise() }),
        altered("sharpened", Alteration::Sharpened { amount: 1.5 }),
        altered("ghosting", Alteration::Ghosting { share: 0.4 }),
        BenchmarkRow { texture: "concrete", ..altered("overlay", Alteration::Overlay) },
        altered("bands", Alteration::Bands { amount: 0.2 }),
        altered("duplicated", Alteration::Duplicated { every: 4 }),
        altered("rain", Alteration::Rain { streaks: 400 }),
        altered("interlaced", Alteration::Interlaced),
        altered("upscaled", Alteration::Upscaled),
        altered("caustics", Alteration::Caustics { amount: 0.3 }),
        altered("drops", Alteration::Drops { count: 12 }),
        altered("snow", Alteration::Snow { flakes: 200 }),
        altered("wheel", Alteration::Wheel { radius_px: 180.0 }),
        concrete_altered("wheel-concrete", Alteration::Wheel { radius_px: 180.0 }),
        altered("reflection", Alteration::Reflection { amount: 0.4 }),
        concrete_altered("reflection-concrete", Alteration::Reflection { amount: 0.3 }),
        altered("swinging", Alteration::Swinging),
        concrete_altered("swinging-concrete", Alteration::Swinging),
        altered("thermal", Alteration::Thermal { gray: 6.0 }),
        concrete_altered("thermal-concrete", Alteration::Thermal { gray: 3.0 }),
        altered("dirty-window", Alteration::DirtyWindow { gray: 12.0 }),
        concrete_altered("dirty-window-concrete", Alteration::DirtyWindow { gray: 12.0 }),
        altered("grille", Alteration::Grille),
        concrete_altered("grille-concrete", Alteration::Grille),
        altered("dark-sensor", Alteration::DarkSensor { light: 0.15 }),
        altered("torn", Alteration::Torn),
        altered("lost-blocks", Alteration::LostBlocks { share: 0.2 }),
        concrete_altered("lost-rows", Alteration::LostRows),
        concrete_altered("row-noise", Alteration::RowNoise { gray: 8.0 }),
        concrete_altered("impulses", Alteration::Impulses { share: 0.02 }),
        BenchmarkRow { texture: "tiles", ..altered("dead-lines", Alteration::DeadLines { count: 10 }) },
        altered("blocky", Alteration::Blocky { quantum: 16.0 }),
        concrete_altered("blocky-concrete", Alteration::Blocky { quantum: 10.0 }),
        altered("tone-mapped", Alteration::ToneMapped),
        altered("clipped", Alteration::Clipped { at: 0.5 }),
        altered("posterized", Alteration::Posterized { levels: 8 }),
        altered("swapped", Alteration::Swapped { every: 10 }),
        concrete_altered("caustics-concrete", Alteration::Caustics { amount: 0.2 }),
    ]
}
