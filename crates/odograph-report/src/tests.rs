use super::*;
use odograph::camera::{Camera, Distortion, Rig};
use odograph::drawing::{Backdrop, MapDrawing, ReckonedStretch};
use odograph::geometry::{GroundPoint, GroundPose, Pixel, Placement, Ray};
use odograph::image::RgbImage;
use odograph::mosaic::{Mosaic, MosaicOptions, MosaicPicture};
use odograph::trajectory::{FrameSummary, LossReason, PlaceSummary, TrackStatus};
use odograph_session::{AlikePlace, PoseInMap, ReportLocalization, ReportMark, ReportMosaic};
use std::f64::consts::TAU;

fn camera() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.28, 0.07, 0.0002, -0.0003]).unwrap();
    Camera::new((320, 240), (260.0, 262.0), (158.0, 121.0), distortion).unwrap()
}

/// A figure eight with an interval of lost frames, at 30 frames per second.
fn figure_eight(count: u64) -> Vec<FrameSummary> {
    let lost = count / 2..count / 2 + count / 12;
    (0..count)
        .map(|k| {
            let (s, rate) = (k as f64 / count as f64, TAU / count as f64 * 30.0);
            let a = TAU * s * 0.97;
            let (vx, vy) = (1.6 * a.cos() * rate, 1.8 * (2.0 * a).cos() * rate);
            let tracked = !lost.contains(&k);
            let place = PlaceSummary {
                x_m: 1.6 * a.sin(),
                y_m: 0.9 * (2.0 * a).sin(),
                heading_rad: vy.atan2(vx),
                height_m: 0.5,
                speed_m_s: vx.hypot(vy),
                position_covariance: [(0.02 * s).powi(2), 0.0, (0.035 * s).powi(2)],
                heading_variance: (0.004 * s).powi(2),
            };
            FrameSummary {
                frame: k,
                time_s: 1000.0 + k as f64 / 30.0,
                place: tracked.then_some(place),
                residual_px: if tracked { 0.12 + 0.05 * (9.0 * a).sin() } else { 0.0 },
                tracks: if tracked { 240 - (40.0 * (3.0 * a).sin()) as u32 } else { 7 },
                inliers: if tracked { 210 - (60.0 * (3.0 * a).sin().abs()) as u32 } else { 0 },
                segment: u32::from(k >= lost.end),
                status: if tracked {
                    TrackStatus::Tracked
                } else {
                    TrackStatus::Lost { reason: LossReason::Bare }
                },
            }
        })
        .collect()
}

/// A floor of coloured tiles with joints.
fn floor(point: GroundPoint) -> [f64; 3] {
    let (u, v) = (point.x_m / 0.2, point.y_m / 0.2);
    let near_joint = |t: f64| (t - t.round()).abs() < 0.03;
    if near_joint(u) || near_joint(v) {
        return [95.0, 90.0, 85.0];
    }
    let tile = ((u.floor() * 12.9898 + v.floor() * 78.233).sin() * 43758.5453).rem_euclid(1.0);
    let grain = 14.0 * ((point.x_m * 160.0).sin() * (point.y_m * 190.0 + 3.0 * tile).sin());
    [165.0 + 60.0 * tile + grain, 150.0 + 50.0 * tile + grain, 128.0 + 40.0 * tile + grain]
}

fn mosaic_of(frames: &[FrameSummary], camera: &Camera) -> Mosaic {
    let rays: Vec<Ray> = (0..320 * 240)
        .map(|k| camera.ray_from_pixel(Pixel::new((k % 320) as f64, (k / 320) as f64)).unwrap())
        .collect();
    let mut mosaic = Mosaic::new(MosaicOptions::default());
    for at in frames.iter().filter_map(|frame| frame.place) {
        let (x_m, y_m, heading_rad) = (at.x_m, at.y_m, at.heading_rad);
        let pose = GroundPose { x_m, y_m, heading_rad, ..GroundPose::level(at.height_m) };
        if mosaic.wants(camera, &pose) {
            let colour =
                |ray: &Ray| floor(pose.ground_from_ray(*ray).unwrap()).map(|c| c.clamp(0.0, 255.0) as u8);
            let image = RgbImage::from_samples(320, 240, rays.iter().flat_map(colour).collect()).unwrap();
            mosaic.add(&image, camera, &pose);
        }
    }
    mosaic
}

fn report(frames: &[FrameSummary], title: &str, warnings: &[String]) -> String {
    report_with(None, frames, title, warnings)
}

fn report_with(
    mosaic: Option<ReportMosaic<'_>>,
    frames: &[FrameSummary],
    title: &str,
    warnings: &[String],
) -> String {
    report_until(None, mosaic, frames, title, warnings)
}

/// The report of a run that may have been interrupted.
fn report_until(
    interruption: Option<&str>,
    mosaic: Option<ReportMosaic<'_>>,
    frames: &[FrameSummary],
    title: &str,
    warnings: &[String],
) -> String {
    report_of(None, interruption, mosaic, frames, title, warnings)
}

/// The report of a run that may have looked for its place in a map.
fn report_of(
    localization: Option<ReportLocalization<'_>>,
    interruption: Option<&str>,
    mosaic: Option<ReportMosaic<'_>>,
    frames: &[FrameSummary],
    title: &str,
    warnings: &[String],
) -> String {
    let map = MapDrawing { title, ..MapDrawing::default() }.svg(frames);
    html(&ReportInput {
        interruption,
        title,
        source: "drive.mp4, 320 × 240 pixels",
        frames,
        reckoned: &[],
        camera: &camera(),
        rig: &Rig::level(0.5),
        map_svg: &map,
        keyframes: &[GroundPoint::new(0.0, 0.0), GroundPoint::new(1.6, 0.0)],
        landmarks: &[],
        loops: &[[GroundPoint::new(1.0, 0.5), GroundPoint::new(1.1, 0.5)]],
        marks: &[ReportMark { name: "a <door>".into(), time_s: 2.0 }],
        mosaic,
        run_toml: "height_m = 0.5\nmodel = \"rigid\"\n",
        files: &["odometry.tum", "map.gpkg"],
        warnings,
        sensors: &[],
        reference: None,
        localization,
    })
}

#[test]
fn a_loss_is_drawn_as_other_sensors_have_the_path() {
    let frames = figure_eight(900);
    let picture = mosaic_of(&frames, &camera()).picture_within(400).unwrap();
    let placement = picture.placement;
    let mosaic = Some(ReportMosaic { picture: &picture, placement, file_name: "mosaic.png" });
    // Frames 450 to 524 are lost.
    let stretch = ReckonedStretch {
        from_s: frames[450].time_s,
        to_s: frames[524].time_s,
        points: vec![GroundPoint::new(0.3, 0.4), GroundPoint::new(0.2, 0.5)],
    };
    let page = |reckoned: &[ReckonedStretch]| {
        html(&ReportInput {
            interruption: None,
            title: "drive",
            source: "drive.mp4",
            frames: &frames,
            reckoned,
            camera: &camera(),
            rig: &Rig::level(0.5),
            map_svg: "",
            keyframes: &[],
            landmarks: &[],
            loops: &[],
            marks: &[],
            mosaic,
            run_toml: "",
            files: &[],
            warnings: &[],
            sensors: &[],
            reference: None,
            localization: None,
        })
    };
    let by_sensors = page(std::slice::from_ref(&stretch));
    assert!(
        by_sensors.contains("lost once, for 2.50 s; the dashed path there is that of the other sensors.")
    );
    let (x, y) = placement.pixel_from_ground(stretch.points[1]);
    let losses = by_sensors.split("<g class=\"losses\">").nth(1).unwrap().split("</g>").next().unwrap();
    assert!(losses.contains("class=\"reckoned\"") && !losses.contains("class=\"line\""), "{losses}");
    assert!(losses.contains(&format!("L{x:.1} {y:.1}L")), "{losses}");
    assert!(by_sensors.contains("lost: path by other sensors"), "the map, too");
    let alone = page(&[]);
    assert!(alone.contains("lost once, for 2.50 s; no path is drawn there."));
    assert!(alone.contains("<g class=\"losses\"><path class=\"line\""));
}

#[test]
fn a_localized_picture_lies_on_the_map() {
    let placement = Placement { metres_per_pixel: 0.02, x_m: -1.99, y_m: 1.99 };
    let ground = MosaicPicture { width: 200, height: 200, rgba: vec![200; 4 * 200 * 200], placement };
    let placement = Placement { metres_per_pixel: 0.01, x_m: 0.505, y_m: 0.495 };
    let picture = MosaicPicture { width: 80, height: 60, rgba: vec![90; 4 * 80 * 60], placement };
    let mosaic = ReportMosaic { picture: &picture, placement, file_name: "mosaic.png" };
    let place = PoseInMap {
        frame: 0,
        time_s: 0.0,
        x_m: 0.9,
        y_m: 0.2,
        heading_deg: 90.0,
        sd_x_m: 0.0002,
        sd_y_m: 0.0003,
        sd_heading_deg: 0.01,
        keyframe: 7,
        keyframe_distance_m: 0.12,
        session: 2,
    };
    let alike = [(0.7, 0.9), (0.3, -0.7)].map(|(probability, x_m)| AlikePlace {
        probability,
        x_m,
        y_m: 0.2,
        heading_deg: 90.0,
        keyframe: 7,
        session: 2,
        evidence: 12.0,
        matches: 40,
        shared: 100,
    });
    let frames = &figure_eight(60)[..1];
    let page = |place: Option<&PoseInMap>, alike: &[AlikePlace]| {
        let reason = if place.is_some() { "" } else { "cannot tell" };
        let localization = ReportLocalization { place, reason, alike, ground: Some(&ground) };
        report_of(Some(localization), None, Some(mosaic), frames, "photo.jpg", &[])
    };
    let found = page(Some(&place), &[]);
    assert_sound(&found);
    // 0.5 m right of the middle is pixel 124.5 of the map; the picture is half as large there.
    assert!(found.contains("<image x=\"124.50\" y=\"74.50\" width=\"40.00\" height=\"30.00\""), "{found}");
    assert!(found.contains("± 0.20 mm") && found.contains("of session 2"));
    assert!(!found.contains("travelled"));
    let unsure = page(None, &alike);
    assert_sound(&unsure);
    assert!(unsure.contains("No place is certain") && !unsure.contains("<image"));
    assert!(unsure.contains(">70 %</td>") && unsure.contains(">30 %</text>"));
}

/// The report of a run with a mosaic.
fn report_over_ground(frames: &[FrameSummary]) -> String {
    // 4 m wide and 2 m high, 1 cm a pixel, the origin in the middle.
    let placement = Placement { metres_per_pixel: 0.01, x_m: -1.995, y_m: 0.995 };
    let picture = MosaicPicture { width: 400, height: 200, rgba: vec![255; 4 * 400 * 200], placement };
    let mosaic = ReportMosaic { picture: &picture, placement, file_name: "mosaic.png" };
    report_with(Some(mosaic), frames, "drive", &[])
}

/// Asserts that all elements are closed in order, and that the page has no external references.
fn assert_sound(page: &str) {
    const VOID: [&str; 4] = ["meta", "img", "br", "!doctype"];
    let mut open = vec![];
    let body = page.split("</style>").nth(1).unwrap();
    // The data and the script are the end of the page; they are no markup.
    let (body, scripts) = body.split_once("<script").unwrap_or((body, ""));
    for outside in ["import", "fetch", "XMLHttp", "src=", "href"] {
        assert!(!scripts.contains(outside), "{outside}");
    }
    for tag in body.split('<').skip(1) {
        let tag = tag.split('>').next().unwrap();
        let name = tag.split_whitespace().next().unwrap();
        if let Some(name) = tag.strip_prefix('/') {
            if open.last() == Some(&name) {
                open.pop();
            } else {
                assert!(matches!(name, "head" | "html" | "style"), "{name} closes, {open:?} are open");
            }
        } else if !tag.ends_with('/') && !VOID.contains(&name) {
            open.push(name);
        }
    }
    let unclosed: &[&str] = if scripts.is_empty() { &[] } else { &["html", "body"] };
    assert!(open.iter().all(|name| unclosed.contains(name)), "{open:?}");
    for outside in ["href=\"http", "src=\"http", "url(http", "@import", "NaN", ">inf"] {
        assert!(!page.contains(outside), "{outside}");
    }
}

#[test]
fn the_map_is_rendered_with_its_labels() {
    let frames = figure_eight(600);
    let svg = MapDrawing { title: "drive", ..MapDrawing::default() }.svg(&frames);
    let png = drawing_png(&svg, 1600).unwrap();
    let mut reader = png::Decoder::new(std::io::Cursor::new(&png)).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    assert_eq!(info.width, 1600);
    let dark = |rows: std::ops::Range<usize>| {
        pixels[rows.start * 4800..rows.end * 4800]
            .chunks_exact(3)
            .filter(|p| p.iter().all(|&c| c < 90))
            .count()
    };
    assert!(dark(30..70) > 200, "the title is set in the program's own typeface");
    assert_eq!(png, drawing_png(&svg, 1600).unwrap(), "the same bytes twice");
    assert!(drawing_png("no drawing", 1600).is_err());
}

#[test]
fn the_report_describes_the_run() {
    let frames = figure_eight(600);
    let page = report(&frames, "drive", &[]);
    assert_sound(&page);
    assert!(page.contains("Tracking was lost once, for 1.67 s"));
    assert!(page.contains("too little texture") && page.contains("550 of 600 frames"));
    assert_eq!(page, report(&frames, "drive", &[]), "the same bytes twice");
}

#[test]
fn an_interrupted_run_is_not_reported_as_a_whole_one() {
    let mut frames = figure_eight(600);
    frames.retain(|frame| frame.place.is_some());
    frames.iter_mut().for_each(|frame| frame.segment = 0);
    let whole = report(&frames, "drive", &[]);
    let interruption = "interrupted after 550 of 600 frames";
    let until = report_until(Some(interruption), None, &frames, "drive", &[]);
    assert_sound(&until);
    assert!(until.contains(interruption) && until.contains("Every frame up to there was tracked."));
    for sentence in
        ["Every frame was tracked.", "Every frame has a pose.", "From the first frame to the last.<"]
    {
        assert!(whole.contains(sentence) && !until.contains(sentence), "{sentence}");
    }
}

#[test]
fn the_card_states_the_deviation_of_the_plots() {
    // 3.5 cm times 599/600 at the last frame.
    let page = report(&figure_eight(600), "drive", &[]);
    assert!(page.contains("<b>± 34.9 mm</b>") && page.contains("one standard deviation, as in the plots"));
    assert!(page.contains(",0.034942,"), "of the last frame, as the plots have it");
}

#[test]
fn files_beside_the_report_are_linked() {
    let page = report(&figure_eight(60), "drive", &[]);
    let links = "<a href=\"odometry.tum\">odometry.tum</a>, <a href=\"map.gpkg\">map.gpkg</a>.";
    assert!(page.contains(links) && !page.contains("carrier.tum"));
}

#[test]
fn errors_beside_each_other_have_one_unit() {
    let texts = crate::parts::lengths_text;
    assert_eq!(texts([0.000_667, 0.000_571, 0.001_6]), ["0.67 mm", "0.57 mm", "1.60 mm"]);
    assert_eq!(texts([0.004, 0.002, 1.2]), ["0.004 m", "0.002 m", "1.200 m"]);
    assert_eq!(crate::parts::lengths_text([0.0, 2e-6]), ["0.00 µm", "2.00 µm"]);
}

#[test]
fn names_are_escaped_in_the_page() {
    let page = report(&figure_eight(60), "<script>alert('x')</script>.mp4", &["a <b> & \"c\"".into()]);
    assert_sound(&page);
    assert!(page.contains("&lt;script&gt;") && page.contains("a &lt;b&gt; &amp; &quot;c&quot;"));
}

#[test]
fn empty_and_wholly_lost_runs_have_a_report() {
    let mut frames = figure_eight(60);
    for frame in &mut frames {
        frame.status = TrackStatus::Lost { reason: LossReason::Jump };
        frame.place = None;
    }
    for frames in [&[][..], &frames[..1], &frames[..]] {
        let page = report(frames, "drive", &[]);
        assert_sound(&page);
        assert!(page.contains("No frame could be tracked"));
    }
    assert_sound(&report(&figure_eight(60)[..1], "one pose", &[]));
}

#[test]
fn the_report_of_an_hour_is_small() {
    let page = report(&figure_eight(108_000), "an hour", &[]);
    assert!(page.len() < 3_000_000, "{} bytes", page.len());
}

#[test]
fn the_path_lies_over_the_ground_it_saw() {
    let frames = figure_eight(600);
    let page = report_over_ground(&frames);
    assert_sound(&page);
    let [said, shown] = ["<p class=\"readout\"", "<div class=\"view\""].map(|part| page.find(part).unwrap());
    assert!(said < shown, "the frame pointed at is described below the picture, off a small screen");
    let over = page.split("<div class=\"over\">").nth(1).unwrap().split("</svg>").next().unwrap();
    assert!(over.contains("viewBox=\"-0.5 -0.5 400 200\""), "{over}");
    // Two segments, each with its casing; from the origin, over a quarter of the eight to (1.6, 0).
    let lines: Vec<&str> =
        over.split("points=\"").skip(1).map(|rest| rest.split('"').next().unwrap()).collect();
    assert_eq!(lines.len(), 4);
    assert!(lines[0].starts_with("199.5,99.5 "), "{}", lines[0]);
    let right = lines[0].split([' ', ',']).step_by(2).map(|x| x.parse::<f64>().unwrap()).fold(0.0, f64::max);
    assert!((right - 359.5).abs() < 1.0, "{right}");
    // A loss that ends where earlier ground is recognised begins no segment, and is no path either.
    let mut bridged = figure_eight(600);
    bridged.iter_mut().for_each(|frame| frame.segment = 0);
    let page = report_over_ground(&bridged);
    assert!(page.contains(over), "the loss is drawn as a path");
}

#[test]
fn layers_of_the_ground_are_those_that_exist() {
    let frames = figure_eight(600);
    let page = report_over_ground(&frames);
    for class in ["way", "losses", "keyframes", "loops", "marks"] {
        assert!(page.contains(&format!("<g class=\"{class}\">")), "{class}");
        assert!(page.contains(&format!("class=\"shows-{class}\"")), "{class}");
    }
    assert!(page.contains("<g class=\"keyframes\"><path class=\"dot\" d=\"M199.5 99.5h0M359.5 99.5h0\"/>"));
    assert!(page.contains("a &lt;door&gt;</text>"));
    let sure: Vec<_> = frames.iter().take(200).cloned().collect();
    assert!(!report_over_ground(&sure).contains("<g class=\"losses\">"));
}

#[test]
fn every_frame_with_a_pose_is_in_the_data_of_the_page() {
    let frames = figure_eight(600);
    let page = report(&frames, "drive", &[]);
    let rows = |page: &str| {
        page.split("\"rows\":[").nth(1).unwrap().split("]}").next().unwrap().matches('[').count()
    };
    assert_eq!(rows(&page), 550);
    assert_eq!(rows(&report(&figure_eight(108_000), "an hour", &[])), 3960);
    // The first row is at the origin, heading along the eight's first tangent.
    assert!(page.contains("\"rows\":[\n[0.000,0.0000,0.0000,"), "the first row");
}

#[test]
fn a_sure_run_has_no_section_about_doubts() {
    let mut frames = figure_eight(600);
    assert!(report(&frames, "drive", &[]).contains("Where it was unsure"));
    frames.retain(|frame| frame.place.is_some());
    frames.iter_mut().for_each(|frame| frame.segment = 0);
    let page = report(&frames, "drive", &[]);
    assert!(!page.contains("Where it was unsure"));
    frames[70].inliers = 20;
    let page = report(&frames, "drive", &[]);
    assert!(page.contains("Where it was unsure") && page.contains("few inliers"));
    assert_sound(&page);
}

/// Trajectories that are hard to draw well.
fn odd_paths() -> Vec<(&'static str, Vec<FrameSummary>)> {
    let along = |count: u64, pose: &dyn Fn(f64) -> (f64, f64, f64)| -> Vec<FrameSummary> {
        let mut frames = figure_eight(count);
        for (k, frame) in frames.iter_mut().enumerate() {
            if let Some(place) = &mut frame.place {
                (place.x_m, place.y_m, place.heading_rad) = pose(k as f64 / count as f64);
            }
        }
        frames
    };
    let mut lost_at_the_end = along(300, &|s| (300.0 * s, 4000.0 * s, 1.5));
    for frame in &mut lost_at_the_end[250..] {
        frame.status = TrackStatus::Lost { reason: LossReason::Jump };
        frame.place = None;
    }
    vec![
        ("none", vec![]),
        ("straight", along(600, &|s| (10.0 * s, 0.01 * (9.0 * s).sin(), 0.0))),
        ("kilometres", lost_at_the_end),
        ("pivot", along(600, &|s| (0.4 - 0.4 * (TAU * s).cos(), -0.4 * (TAU * s).sin(), -TAU * s))),
        ("still", along(100, &|s| (2e-5 * (40.0 * s).sin(), 2e-5 * (70.0 * s).cos(), 0.0))),
        (
            "lanes",
            along(3000, &|s| {
                let (lane, t) = ((8.0 * s).floor(), (8.0 * s).fract());
                let back = lane % 2.0 > 0.5;
                (if back { 5.0 - 5.0 * t } else { 5.0 * t }, 0.4 * lane, if back { TAU / 2.0 } else { 0.0 })
            }),
        ),
    ]
}

/// Writes all outputs for inspection into the folder named by `ODOGRAPH_LOOK`; skipped if it is not
/// set.
#[test]
fn a_look() {
    let Some(folder) = std::env::var_os("ODOGRAPH_LOOK").map(std::path::PathBuf::from) else {
        println!("skipped: look: ODOGRAPH_LOOK names no folder");
        return;
    };
    let write = |name: &str, bytes: &[u8]| odograph_session::files::write(&folder.join(name), bytes).unwrap();
    let (frames, camera) = (figure_eight(900), camera());
    let mosaic = mosaic_of(&frames, &camera);
    let whole = mosaic.picture().unwrap();
    let small = mosaic.picture_within(1600).unwrap();
    let png = odograph_session::files::png_from_rgba(small.width, small.height, &small.rgba).unwrap();
    let backdrop = Backdrop {
        png: &png,
        width_px: small.width,
        height_px: small.height,
        placement: small.placement,
        opacity: 0.6,
    };
    let plain = MapDrawing { title: "figure-eight.mp4", ..MapDrawing::default() };
    let backed = MapDrawing { backdrop: Some(backdrop), ..plain };
    for (name, drawing) in [
        ("map", plain),
        ("map-backed", backed),
        ("map-narrow", MapDrawing { width: 460.0, title: "", ..plain }),
    ] {
        let svg = drawing.svg(&frames);
        write(&format!("{name}.svg"), svg.as_bytes());
        let width = if name == "map-narrow" { 700 } else { MAP_WIDTH_PX };
        write(&format!("{name}.png"), &drawing_png(&svg, width).unwrap());
    }
    for (name, path) in odd_paths() {
        let svg =
            MapDrawing { title: &format!("{name} {}", "of a very long name".repeat(8)), ..plain }.svg(&path);
        write(&format!("map-{name}.png"), &drawing_png(&svg, 1000).unwrap());
    }
    let png_whole = odograph_session::files::png_from_rgba(whole.width, whole.height, &whole.rgba).unwrap();
    write("mosaic.png", &png_whole);
    write("mosaic.pgw", whole.placement.world_file().as_bytes());
    let page = html(&ReportInput {
        interruption: None,
        title: "figure-eight.mp4",
        source: "A rendered floor of tiles, 320 × 240 pixels, 900 frames at 30 a second",
        frames: &frames,
        reckoned: &[],
        camera: &camera,
        rig: &Rig::level(0.5),
        map_svg: &plain.svg(&frames),
        keyframes: &[],
        landmarks: &[],
        loops: &[],
        marks: &[],
        mosaic: Some(ReportMosaic { picture: &small, placement: whole.placement, file_name: "mosaic.png" }),
        run_toml: "height_m = 0.5\nmodel = \"rigid\"\nseed = 1\n",
        files: &["mosaic.png"],
        warnings: &["the video ends in the middle of a frame; 900 of about 905 frames were read".into()],
        sensors: &[],
        reference: None,
        localization: None,
    });
    write("report.html", page.as_bytes());
}
