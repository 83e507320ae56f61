use super::*;
use crate::trajectory::{LossReason, PlaceSummary, TrackStatus};
use proptest::prelude::*;

fn tracked(number: u64, x_m: f64, y_m: f64, heading_rad: f64, sigma_m: f64) -> FrameSummary {
    let variance = sigma_m * sigma_m;
    FrameSummary {
        frame: number,
        time_s: 100.0 + number as f64 / 30.0,
        place: Some(PlaceSummary {
            x_m,
            y_m,
            heading_rad,
            height_m: 1.0,
            speed_m_s: 0.0,
            position_covariance: [variance, 0.2 * variance, 0.3 * variance],
            heading_variance: 0.0,
        }),
        residual_px: 0.1,
        tracks: 200,
        inliers: 180,
        segment: 0,
        status: TrackStatus::Tracked,
    }
}

fn lost(number: u64) -> FrameSummary {
    FrameSummary {
        status: TrackStatus::Lost { reason: LossReason::Bare },
        place: None,
        ..tracked(number, 0.0, 0.0, 0.0, 0.0)
    }
}

/// A crude check that the text is well formed: every tag that opens closes, in order.
fn assert_well_formed(svg: &str) {
    let mut open = vec![];
    for tag in svg.split('<').skip(1) {
        let tag = &tag[..tag.find('>').expect("a tag closes")];
        if let Some(name) = tag.strip_prefix('/') {
            assert_eq!(open.pop(), Some(name), "closed in order");
        } else if !tag.ends_with('/') {
            open.push(tag.split_whitespace().next().unwrap());
        }
    }
    assert!(open.is_empty(), "{open:?}");
    assert!(!svg.contains("NaN") && !svg.contains("inf"));
}

fn drawn(frames: &[FrameSummary]) -> String {
    let svg = MapDrawing { title: "a <drive> & more", ..MapDrawing::default() }.svg(frames);
    assert_well_formed(&svg);
    svg
}

#[test]
fn nothing_one_pose_and_standing_still_are_drawn() {
    assert!(drawn(&[]).contains("no frame has a pose"));
    assert!(drawn(&[lost(0), lost(1)]).contains("no frame has a pose"));
    assert!(drawn(&[tracked(0, 0.0, 0.0, 0.0, 0.0)]).contains("start, end"));
    let still: Vec<_> = (0..300).map(|k| tracked(k, 1e-6 * (k % 3) as f64, 0.0, 0.0, 0.0)).collect();
    assert!(drawn(&still).contains("start, end"));
}

#[test]
fn millimetres_and_kilometres_get_their_units() {
    let walk =
        |step: f64| -> Vec<_> { (0..100).map(|k| tracked(k, step * k as f64, 0.0, 0.0, 0.0)).collect() };
    assert!(drawn(&walk(0.0002)).contains("forward at the start (mm)"));
    assert!(drawn(&walk(0.05)).contains("forward at the start (m)"));
    assert!(drawn(&walk(300.0)).contains("forward at the start (km)"));
}

#[test]
fn a_drawing_of_100_000_poses_is_small_and_deterministic() {
    let frames: Vec<_> = (0..100_000)
        .map(|k| (k, k as f64 * 1e-3))
        .map(|(k, a)| tracked(k, 3.0 * a.cos() + 0.02 * a, 2.0 * (1.37 * a).sin(), a, 0.01 * a))
        .collect();
    let svg = drawn(&frames);
    assert!(svg.len() < 400_000, "{} bytes", svg.len());
    assert_eq!(svg, drawn(&frames));
}

#[test]
fn a_gap_is_dashed_and_not_solid() {
    // Ten metres to the right, lost, and seen again 5 m further up.
    let mut frames: Vec<_> = (0..50).map(|k| tracked(k, 0.2 * k as f64, 0.0, 0.0, 0.0)).collect();
    frames.extend((50..60).map(lost));
    frames
        .extend((60..100).map(|k| FrameSummary { segment: 1, ..tracked(k, 0.2 * k as f64, 5.0, 0.0, 0.0) }));
    let svg = drawn(&frames);
    assert!(svg.contains("stroke-dasharray") && svg.contains("lost: path unknown"));
    for line in svg.lines().filter(|line| line.contains("stroke-width=\"3.2\"")) {
        let d = line.split("d=\"M").nth(1).unwrap().trim_end_matches("\"/>").replace('L', " ");
        let ys: Vec<f64> = d.split_whitespace().skip(1).step_by(2).filter_map(|v| v.parse().ok()).collect();
        assert!(ys.windows(2).all(|pair| (pair[0] - pair[1]).abs() < 1.0), "{line}");
    }
    let unbroken: Vec<_> = (0..50).map(|k| tracked(k, 0.2 * k as f64, 0.0, 0.0, 0.0)).collect();
    assert!(!drawn(&unbroken).contains("stroke-dasharray"));
}

#[test]
fn a_gap_that_other_sensors_know_is_drawn_as_they_have_it() {
    let mut frames: Vec<_> = (0..50).map(|k| tracked(k, 0.2 * k as f64, 0.0, 0.0, 0.0)).collect();
    frames.extend((50..60).map(lost));
    frames.extend((60..90).map(|k| FrameSummary { segment: 1, ..tracked(k, 0.2 * k as f64, 0.0, 0.0, 0.0) }));
    frames.extend((90..100).map(lost));
    // A detour of 40 m in the first gap, outside the measured path, and straight on in the second.
    let stretch = |from: u64, to: u64, y_m: f64| ReckonedStretch {
        from_s: lost(from).time_s,
        to_s: lost(to).time_s,
        points: (from..=to).map(|k| GroundPoint::new(0.2 * k as f64, y_m)).collect(),
    };
    let both = [stretch(50, 59, 40.0), stretch(90, 99, 0.0)];
    let with = |reckoned: &[ReckonedStretch]| {
        let svg = MapDrawing { reckoned, ..MapDrawing::default() }.svg(&frames);
        assert_well_formed(&svg);
        svg
    };
    let svg = with(&both);
    assert_eq!(svg.matches("class=\"reckoned\"").count(), 3, "two and the legend: {svg}");
    assert!(svg.contains("lost: path by other sensors") && !svg.contains("path unknown"), "{svg}");
    let window = DrawingWindow::around(&MeasuredPath::new(&frames), &both, None, 1200.0, 20.0);
    let top = window.page(10.0, 40.0);
    assert!(top.1 > window.top && svg.contains(&format!("{} {}", coordinate(top.0), coordinate(top.1))));
    // The second gap alone is known.
    let svg = with(&both[1..]);
    assert!(svg.contains("lost: path by other sensors") && svg.contains("path unknown"), "{svg}");
    // Numbers that cannot be drawn are as none.
    let odd = ReckonedStretch { points: vec![GroundPoint::new(f64::NAN, 0.0)], ..both[0].clone() };
    assert!(with(&[odd]).contains("path unknown"));
}

#[test]
fn world_x_runs_right_and_world_y_up() {
    let frames = [tracked(0, 0.0, 0.0, 0.0, 0.0), tracked(1, 1.0, 0.5, 0.0, 0.0)];
    let window = DrawingWindow::around(&MeasuredPath::new(&frames), &[], None, 1200.0, 20.0);
    let (start, end) = (window.page(0.0, 0.0), window.page(1.0, 0.5));
    assert!(end.0 > start.0 && end.1 < start.1);
    assert!(((end.0 - start.0) - 2.0 * (start.1 - end.1)).abs() < 1e-9, "one scale");
}

#[test]
fn large_uncertainty_is_drawn_and_small_is_not() {
    let walk = |sigma: f64| -> Vec<_> {
        (0..100).map(|k| tracked(k, 0.1 * k as f64, 0.0, 0.0, sigma * k as f64 / 100.0)).collect()
    };
    assert!(drawn(&walk(0.5)).contains("<ellipse"));
    assert!(!drawn(&walk(1e-4)).contains("<ellipse"));
}

#[test]
fn a_backdrop_is_drawn_at_its_placement() {
    let frames = [tracked(0, 0.0, 0.0, 0.0, 0.0), tracked(1, 1.0, 0.0, 0.0, 0.0)];
    let placement = Placement { metres_per_pixel: 0.01, x_m: -0.5, y_m: 0.5 };
    let backdrop = Backdrop { png: b"png", width_px: 200, height_px: 100, placement, opacity: 0.8 };
    let svg = MapDrawing { backdrop: Some(backdrop), ..MapDrawing::default() }.svg(&frames);
    assert_well_formed(&svg);
    let window =
        DrawingWindow::around(&MeasuredPath::new(&frames), &[], Some((placement, 200, 100)), 1200.0, 20.0);
    let corner = window.page(-0.505, 0.505);
    assert!(svg.contains(&format!("<image x=\"{:.3}\" y=\"{:.3}\"", corner.0, corner.1)));
    let odd = Backdrop { placement: Placement { x_m: f64::NAN, ..placement }, ..backdrop };
    assert!(!MapDrawing { backdrop: Some(odd), ..MapDrawing::default() }.svg(&frames).contains("<image"));
}

proptest! {
    #[test]
    fn any_numbers_make_a_well_formed_drawing(values in proptest::collection::vec(
        (proptest::num::f64::ANY, proptest::num::f64::ANY, proptest::num::f64::ANY, proptest::num::f64::ANY), 0..20)) {
        let frames: Vec<_> = values.iter().enumerate().map(|(k, v)| {
            FrameSummary { time_s: v.3, ..tracked(k as u64, v.0, v.1, v.2, v.3) }
        }).collect();
        drawn(&frames);
    }
}
