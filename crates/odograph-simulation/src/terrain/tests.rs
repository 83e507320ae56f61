//! Rays intersect the surface at the first contact, and a vehicle tilts with its wheels.

use super::*;
use crate::noise::uniform;

fn relief(amplitude_m: f64, scale_m: f64) -> Terrain {
    Terrain { relief: Some(Relief { amplitude_m, scale_m }), ..Terrain::default() }
}

fn rough() -> Terrain {
    Terrain {
        undulation: Some(Undulation { amplitude_m: 0.05, wavelength_m: 1.5 }),
        kerb: Some(Kerb { height_m: 0.1, at_m: 0.4 }),
        ramp: Some(Ramp { slope: 0.1, at_m: 0.8 }),
        ..relief(0.015, 0.04)
    }
}

#[test]
fn rays_stop_at_the_first_intersection_with_the_surface() {
    for terrain in [relief(0.005, 0.03), rough(), Terrain { relief: None, ..rough() }] {
        let surface = TerrainSurface::new(&terrain, 5).unwrap();
        for ray in 0..150 {
            let draw = |index: u64| 2.0 * uniform(ray, index) - 1.0;
            let (x, y) = (3.0 * draw(0), 3.0 * draw(1));
            let camera = [x, y, surface.level_m(x, y) + 0.9];
            let per_drop = [0.9 * draw(2), 0.9 * draw(3)];
            let bounds = surface.bounds((x - 1.5, x + 1.5), (y - 1.5, y + 1.5));
            let z = surface.meet(camera, per_drop, bounds);
            let gap = |z: f64| {
                let drop = camera[2] - z;
                z - surface.height_m(camera[0] + drop * per_drop[0], camera[1] + drop * per_drop[1])
            };
            assert!(gap(z).abs() < 2e-6, "ray {ray}: {} m off the surface", gap(z));
            // Ray marching in small steps from above; grazed tips thinner than 0.2 mm may be
            // missed.
            let first =
                (0..30_000).map(|step| camera[2] - 5e-5 * f64::from(step)).find(|z| gap(*z) < -2e-4).unwrap();
            assert!(first < z + 1e-4, "ray {ray} went through the surface at {first}, met it at {z}");
        }
    }
}

#[test]
fn bounds_contain_the_surface_over_their_area() {
    let surface = TerrainSurface::new(&rough(), 5).unwrap();
    for area in 0..200 {
        let draw = |index: u64| uniform(area, index);
        let (x, y, size) = (4.0 * draw(0) - 2.0, 4.0 * draw(1) - 2.0, 0.5 * draw(2));
        let (low, high) = surface.bounds((x, x + size), (y, y + size));
        for place in 0..100 {
            let z =
                surface.height_m(x + size * uniform(area, 10 + place), y + size * uniform(area, 200 + place));
            assert!((low..=high).contains(&z), "{z} is not within {low} to {high}");
        }
    }
}

#[test]
fn the_level_of_the_ground_is_zero_at_the_origin() {
    for at_m in [-1.0, 0.0, 1.0] {
        let terrain = Terrain {
            kerb: Some(Kerb { height_m: 0.1, at_m }),
            ramp: Some(Ramp { slope: -0.2, at_m }),
            ..rough()
        };
        assert_eq!(TerrainSurface::new(&terrain, 1).unwrap().level_m(0.0, 0.0), 0.0);
    }
    assert!(TerrainSurface::new(&Terrain { ride: true, ..Terrain::default() }, 1).is_none());
}

#[test]
fn relief_has_the_configured_amplitude_and_zero_mean() {
    let surface = TerrainSurface::new(&relief(0.01, 0.03), 2).unwrap();
    let heights: Vec<f64> = (0..90_000)
        .map(|i| surface.height_m(f64::from(i % 300) * 0.0061 - 0.9, f64::from(i / 300) * 0.0061))
        .collect();
    let mean = heights.iter().sum::<f64>() / heights.len() as f64;
    let most = heights.iter().fold(0.0f64, |most, height| most.max(height.abs()));
    assert!(mean.abs() < 0.0003 && (0.006..=0.01).contains(&most), "mean {mean}, most {most}");
}

#[test]
fn a_vehicle_tilts_with_its_ramp_at_every_heading() {
    let terrain = Terrain { ramp: Some(Ramp { slope: 0.1, at_m: 1.0 }), ride: true, ..Terrain::default() };
    let surface = TerrainSurface::new(&terrain, 1).unwrap();
    for heading_rad in [0.0, 0.7, 2.0, 9.0] {
        let carrier = GroundPose { x_m: 3.0, y_m: 1.0, heading_rad, ..GroundPose::level(0.5) };
        let pose = surface.ridden(&carrier, carrier);
        assert!((pose.height_m - 0.5 * 0.1f64.atan().cos() - 0.2).abs() < 1e-9, "upright on the ramp");
        // Relative to the vehicle the ramp is level: the vehicle's up axis is the normal of the
        // ramp.
        let up = pose.world_from_camera_rotation() * nalgebra::Vector3::new(0.0, 0.0, -1.0);
        let normal = nalgebra::Vector3::new(-0.1, 0.0, 1.0).normalize();
        assert!((up - normal).norm() < 1e-9, "{up} at heading {heading_rad}");
        assert!((pose.heading_rad - heading_rad).abs() < 0.01, "whole turns stay");
    }
    // Uphill is nose up.
    let uphill = GroundPose { x_m: 3.0, ..GroundPose::level(0.5) };
    assert!((surface.ridden(&uphill, uphill).pitch_rad + 0.1f64.atan()).abs() < 1e-9);
}

#[test]
fn invalid_terrains_are_rejected_by_name() {
    let refused = |terrain: Terrain| terrain.validated().unwrap_err().to_string();
    let undulation = |amplitude_m, wavelength_m| Terrain {
        undulation: Some(Undulation { amplitude_m, wavelength_m }),
        ..Terrain::default()
    };
    assert!(refused(relief(-0.01, 0.03)).contains("relief is -0.01 m"));
    assert!(refused(relief(0.01, f64::NAN)).contains("scale is NaN"));
    assert!(refused(undulation(0.5, 2.0)).contains("undulation is 0.5 m; it must be between 0 and 0.2 m"));
    let ramp = Some(Ramp { slope: f64::INFINITY, at_m: 0.0 });
    assert!(refused(Terrain { ramp, ..Terrain::default() }).contains("slope is inf"));
}
