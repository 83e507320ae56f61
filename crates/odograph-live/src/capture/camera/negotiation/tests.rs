//! Tests with the recorded answers of cameras: their formats as printed by `v4l2-ctl
//! --list-formats-ext`, from public reports of their owners.

#![allow(clippy::unwrap_used)] // a test fails by panicking

use super::*;
use std::collections::BTreeMap;

/// A USB 2 camera with both formats; it lists its first size twice.
const WEBCAM: &str = "\
[0]: 'MJPG' (Motion-JPEG, compressed)
    Size: Discrete 1920x1080
        Interval: Discrete 0.033s (30.000 fps)
    Size: Discrete 1280x720
        Interval: Discrete 0.033s (30.000 fps)
    Size: Discrete 640x480
        Interval: Discrete 0.033s (30.000 fps)
    Size: Discrete 320x240
        Interval: Discrete 0.033s (30.000 fps)
    Size: Discrete 1920x1080
        Interval: Discrete 0.033s (30.000 fps)
[1]: 'YUYV' (YUYV 4:2:2)
    Size: Discrete 640x480
        Interval: Discrete 0.033s (30.000 fps)
    Size: Discrete 320x240
        Interval: Discrete 0.033s (30.000 fps)
    Size: Discrete 640x480
        Interval: Discrete 0.033s (30.000 fps)
";

/// A USB 2 camera whose large uncompressed images have a low frame rate.
const SLOW_WHEN_LARGE: &str = "\
[0]: 'YUYV' (YUYV 4:2:2)
    Size: Discrete 640x480
        Interval: Discrete 0.033s (30.000 fps)
        Interval: Discrete 0.050s (20.000 fps)
        Interval: Discrete 0.067s (15.000 fps)
        Interval: Discrete 0.100s (10.000 fps)
        Interval: Discrete 0.133s (7.500 fps)
    Size: Discrete 1280x720
        Interval: Discrete 0.100s (10.000 fps)
        Interval: Discrete 0.133s (7.500 fps)
    Size: Discrete 960x544
        Interval: Discrete 0.050s (20.000 fps)
        Interval: Discrete 0.067s (15.000 fps)
";

/// The infrared camera of a laptop: luminance only, no exposure control, a single uncommon size.
const GRAY: &str = "\
[0]: 'GREY' (8-bit Greyscale)
    Size: Discrete 640x360
        Interval: Discrete 0.067s (15.000 fps)
        Interval: Discrete 0.033s (30.000 fps)
";

/// The camera of a single-board computer: any size in steps, and formats that are not supported
/// here.
const STEPWISE: &str = "\
[0]: 'YU12' (Planar YUV 4:2:0)
    Size: Stepwise 32x32 - 2592x1944 with step 2/2
[1]: 'YUYV' (YUYV 4:2:2)
    Size: Stepwise 32x32 - 2592x1944 with step 2/2
[2]: 'JPEG' (JFIF JPEG, compressed)
    Size: Stepwise 32x32 - 2592x1944 with step 2/2
[3]: 'H264' (H.264, compressed)
    Size: Stepwise 32x32 - 2592x1944 with step 2/2
";

/// An industrial camera of 12 Mpixel with Bayer images only.
const BAYER: &str = "\
[0]: 'GRBG' (8-bit Bayer GRGR/BGBG)
    Size: Discrete 3872x2764
        Interval: Discrete 0.167s (6.000 fps)
";

type Listed = Vec<((u32, u32), Vec<(u32, u32)>)>;

/// A driver that replays recorded answers.
#[derive(Default)]
struct Recorded {
    formats: Vec<([u8; 4], Option<OfferedSizes>, Listed)>,
    controls: BTreeMap<Control, i32>,
    /// The format that is set, whatever was requested.
    stubborn: Option<Given>,
    /// The frame interval that is set, whatever was requested.
    lazy: Option<(u32, u32)>,
    bytes_per_line: Option<u32>,
    busy: bool,
    asked: Vec<String>,
}

impl Recorded {
    fn camera(printed: &str) -> Self {
        let mut camera = Self::default();
        let pair = |text: &str, between: char| {
            let (a, b) = text.split_once(between).unwrap();
            (a.parse::<u32>().unwrap(), b.parse::<u32>().unwrap())
        };
        for line in printed.lines().map(str::trim) {
            if let Some((_, letters)) = line.split_once("]: '") {
                camera.formats.push((letters.as_bytes()[..4].try_into().unwrap(), None, Vec::new()));
                continue;
            }
            let (_, range, sizes) = camera.formats.last_mut().unwrap();
            if let Some(size) = line.strip_prefix("Size: Discrete ") {
                sizes.push((pair(size, 'x'), Vec::new()));
            } else if let Some(text) = line.strip_prefix("Size: Stepwise ") {
                let words: Vec<&str> = text.split(' ').collect();
                let [least, most, step] = [pair(words[0], 'x'), pair(words[2], 'x'), pair(words[5], '/')];
                *range = Some(OfferedSizes::Range { least, most, step });
            } else {
                let rate = line.split_once('(').unwrap().1.split_once(' ').unwrap().0;
                let rate: f64 = rate.parse().unwrap();
                // In units of 100 ns, like the Linux driver for USB cameras.
                sizes.last_mut().unwrap().1.push(((1e7 / rate).round() as u32, 10_000_000));
            }
        }
        camera
    }

    fn with_exposure(mut self) -> Self {
        // Automatic exposure with fixed aperture, 15.6 ms, automatic white balance.
        self.controls =
            [(Control::ExposureAuto, 3), (Control::Exposure, 156), (Control::WhiteBalanceAuto, 1)].into();
        self
    }

    fn found(&self, fourcc: [u8; 4]) -> io::Result<&([u8; 4], Option<OfferedSizes>, Listed)> {
        let einval = || io::Error::from_raw_os_error(22);
        self.formats.iter().find(|(known, ..)| *known == fourcc).ok_or_else(einval)
    }

    fn set_up(&mut self, wish: ModeWish) -> std::result::Result<Agreed, String> {
        set_up(self, &wish, Path::new("/dev/video7")).map_err(|error| error.to_string())
    }
}

impl Driver for Recorded {
    fn formats(&self) -> Vec<[u8; 4]> {
        self.formats.iter().map(|(fourcc, ..)| *fourcc).collect()
    }

    fn sizes(&self, fourcc: [u8; 4]) -> io::Result<OfferedSizes> {
        let (_, range, sizes) = self.found(fourcc)?;
        Ok(range
            .clone()
            .unwrap_or_else(|| OfferedSizes::Listed(sizes.iter().map(|(size, _)| *size).collect())))
    }

    fn intervals(&self, fourcc: [u8; 4], size: (u32, u32)) -> io::Result<OfferedIntervals> {
        let (_, range, sizes) = self.found(fourcc)?;
        if range.is_some() {
            return Ok(OfferedIntervals::Range { shortest: (1, 90), longest: (1, 1) });
        }
        let listed = sizes.iter().find(|(known, _)| *known == size);
        listed
            .map(|(_, intervals)| OfferedIntervals::Listed(intervals.clone()))
            .ok_or_else(|| io::Error::from_raw_os_error(22))
    }

    fn set_format(&mut self, fourcc: [u8; 4], (width, height): (u32, u32)) -> io::Result<Given> {
        if self.busy {
            return Err(io::Error::from_raw_os_error(16));
        }
        self.asked.push(format!("{} {width}x{height}", String::from_utf8_lossy(&fourcc)));
        let bytes_per_line = self.bytes_per_line.unwrap_or(if &fourcc == b"YUYV" { 2 * width } else { 0 });
        Ok(self.stubborn.unwrap_or(Given { fourcc, width, height, bytes_per_line }))
    }

    fn set_interval(&mut self, seconds: (u32, u32)) -> io::Result<(u32, u32)> {
        self.asked.push(format!("{}/{} s", seconds.0, seconds.1));
        Ok(self.lazy.unwrap_or(seconds))
    }

    fn control(&self, control: Control) -> io::Result<i32> {
        self.controls.get(&control).copied().ok_or_else(|| io::Error::from_raw_os_error(22))
    }

    fn set_control(&mut self, control: Control, value: i32) -> io::Result<()> {
        self.asked.push(format!("{control:?} {value}"));
        let there = self.controls.get_mut(&control).ok_or_else(|| io::Error::from_raw_os_error(22))?;
        *there = value;
        // A camera that resets its exposure when switched to manual.
        if control == Control::ExposureAuto && value == EXPOSURE_MANUAL {
            self.controls.insert(Control::Exposure, 3);
        }
        Ok(())
    }
}

fn size(width: u32, height: u32) -> ModeWish {
    ModeWish { size: Some((width, height)), ..ModeWish::default() }
}

#[test]
fn each_recorded_camera_gets_its_best_mode() {
    let chosen = |printed: &str, wish: ModeWish| {
        let mut camera = Recorded::camera(printed);
        let agreed = camera.set_up(wish)?;
        assert!(agreed.warnings.is_empty(), "{agreed:?}");
        Ok::<_, String>((agreed.mode.to_string(), agreed.bytes_per_line, camera.asked.join(", ")))
    };
    let plan = |mode: &str, bytes: usize, asked: &str| Ok((mode.to_owned(), bytes, asked.to_owned()));
    let any = ModeWish::default();
    let third = "333333/10000000 s";
    assert_eq!(
        chosen(WEBCAM, any),
        plan("640x480 yuyv at 30 frames/s", 1280, &format!("YUYV 640x480, {third}"))
    );
    assert_eq!(
        chosen(WEBCAM, size(1280, 720)),
        plan("1280x720 mjpeg at 30 frames/s", 0, &format!("MJPG 1280x720, {third}"))
    );
    assert_eq!(
        chosen(SLOW_WHEN_LARGE, size(1280, 720)),
        plan("1280x720 yuyv at 10 frames/s", 2560, "YUYV 1280x720, 1000000/10000000 s")
    );
    let slowly = ModeWish { frames_per_second: Some(8.0), ..any };
    assert_eq!(
        chosen(SLOW_WHEN_LARGE, slowly),
        plan("640x480 yuyv at 7.5 frames/s", 1280, "YUYV 640x480, 1333333/10000000 s")
    );
    assert_eq!(
        chosen(GRAY, any),
        plan("640x360 grey at 30 frames/s", 640, &format!("GREY 640x360, {third}"))
    );
    assert_eq!(chosen(STEPWISE, any), plan("640x480 yuyv at 30 frames/s", 1280, "YUYV 640x480, 1/30 s"));
    let jpeg = ModeWish { format: Some(PixelFormat::Jpeg), ..size(1280, 960) };
    assert_eq!(chosen(STEPWISE, jpeg), plan("1280x960 mjpeg at 30 frames/s", 0, "JPEG 1280x960, 1/30 s"));
    let error = chosen(GRAY, size(640, 480)).unwrap_err();
    assert_eq!(error, "/dev/video7: the camera has no mode 640x480; it has 640x360 grey");
    let error = chosen(BAYER, any).unwrap_err();
    assert!(error.contains("no mode that is read here (GREY, YUYV or MJPEG)"), "{error}");
}

#[test]
fn every_mode_is_listed_once() {
    let listed = |printed: &str| modes(&Recorded::camera(printed));
    assert_eq!([WEBCAM, SLOW_WHEN_LARGE, GRAY, BAYER].map(|printed| listed(printed).len()), [6, 9, 2, 0]);
    // Six common sizes and both ends, three rates each, two formats.
    assert_eq!(listed(STEPWISE).len(), 8 * 3 * 2);
    // A driver that does not report frame rates has modes as well.
    let mut camera = Recorded::camera(GRAY);
    camera.formats[0].2[0].1.clear();
    camera.formats[0].1 = Some(OfferedSizes::Listed(vec![(640, 360), (320, 180)]));
    assert!(modes(&camera).iter().all(|mode| mode.width >= 320));
}

#[test]
fn deviations_of_the_driver_are_reported() {
    let mut camera = Recorded::camera(WEBCAM);
    camera.lazy = Some((1, 15));
    let agreed = camera.set_up(ModeWish::default()).unwrap();
    assert_eq!(agreed.mode.to_string(), "640x480 yuyv at 15 frames/s");
    assert_eq!(agreed.warnings, ["/dev/video7: 30.0 frames/s were asked for, it gives 15.0 frames/s"]);
    let mut camera = Recorded::camera(WEBCAM);
    camera.stubborn = Some(Given { fourcc: *b"MJPG", width: 640, height: 480, bytes_per_line: 0 });
    let error = camera.set_up(ModeWish::default()).unwrap_err();
    assert_eq!(error, "/dev/video7 promised 640x480 yuyv at 30 frames/s and gives 640x480 MJPG");
    let mut camera = Recorded::camera(WEBCAM);
    camera.busy = true;
    let error = camera.set_up(ModeWish::default()).unwrap_err();
    assert_eq!(error, "/dev/video7 cannot be set up: it is in use by another program");
    // Padded rows, and a driver that does not report the row stride.
    for (reported, bytes) in [(1344, 1344), (0, 1280)] {
        let mut camera = Recorded::camera(WEBCAM);
        camera.bytes_per_line = Some(reported);
        assert_eq!(camera.set_up(ModeWish::default()).unwrap().bytes_per_line, bytes);
    }
}

#[test]
fn exposure_is_fixed_at_its_automatic_value() {
    let mut camera = Recorded::camera(WEBCAM).with_exposure();
    hold_exposure(&mut camera).unwrap();
    assert_eq!(camera.asked, ["ExposureAuto 1", "Exposure 156", "WhiteBalanceAuto 0"]);
    assert_eq!(camera.controls[&Control::Exposure], 156);
    // Without the control the exposure cannot be fixed, and the caller reports it.
    let mut camera = Recorded::camera(GRAY);
    assert_eq!(hold_exposure(&mut camera).unwrap_err().raw_os_error(), Some(22));
}
