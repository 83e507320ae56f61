//! Image folders (order, timestamps, formats), and invalid sources.

use odograph::error::{ErrorKind, Result};
use odograph_video::{Frame, SourceOptions, open};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

fn png(color: png::ColorType, depth: png::BitDepth, width: u32, height: u32, samples: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.write_header().unwrap().write_image_data(samples).unwrap();
    bytes
}

fn gray_png(value: u8) -> Vec<u8> {
    png(png::ColorType::Grayscale, png::BitDepth::Eight, 2, 2, &[value; 4])
}

fn folder(files: &[(&str, Vec<u8>)]) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }
    folder
}

fn read(path: &Path, options: &SourceOptions) -> Result<(Vec<Frame>, Vec<String>)> {
    let mut source = open(path, options)?;
    let mut frames = Vec::new();
    while let Some(frame) = source.next_frame()? {
        frames.push(frame);
    }
    Ok((frames, source.take_warnings()))
}

fn first_samples(frames: &[Frame]) -> Vec<u8> {
    frames.iter().map(|f| f.gray.samples()[0]).collect()
}

/// Reads an invalid source; returns its error message, which must be one sentence.
fn sentence(path: &Path) -> String {
    let error = read(path, &SourceOptions::default()).unwrap_err();
    let text = error.to_string();
    assert_eq!(error.kind(), ErrorKind::Input, "{text}");
    assert!(!text.contains('\n') && text.len() < 500, "{text}");
    assert!(text.starts_with(&path.display().to_string()), "{text}");
    text
}

#[test]
fn images_are_in_natural_order_at_the_default_rate() {
    let folder = folder(&[
        ("f10.png", gray_png(10)),
        ("f9.pgm", b"P5 2 2 255\n\x09\x09\x09\x09".to_vec()),
        ("f1.PNG", gray_png(1)),
        ("notes.txt", b"hello".to_vec()),
        ("._f1.png", b"junk".to_vec()),
    ]);
    let (frames, warnings) = read(folder.path(), &SourceOptions::default()).unwrap();
    assert_eq!(first_samples(&frames), [1, 9, 10]);
    assert_eq!(frames[2].time_s, 2.0 / 30.0);
    assert_eq!(warnings.len(), 1);
    assert!(
        warnings[0].contains("30 frames a second are assumed; give --timestamps or --fps"),
        "{warnings:?}"
    );

    let with_rate = SourceOptions { fps: Some(4.0), ..SourceOptions::default() };
    let (frames, warnings) = read(folder.path(), &with_rate).unwrap();
    assert_eq!((frames[2].time_s, warnings.len()), (0.5, 0));
}

#[test]
fn timestamps_files_in_every_format() {
    let folder = folder(&[
        ("a.png", gray_png(1)),
        ("b.png", gray_png(2)),
        ("c.png", gray_png(3)),
        ("tum.txt", b"# rgb\n1.5 rgb/b.png\n2.25 rgb/c.png\n".to_vec()),
        ("euroc.csv", b"#timestamp [ns],filename\n1000000000,c.png\n1500000000,a.png\n".to_vec()),
        ("bare.txt", b"0\n0.5\n4\n".to_vec()),
        ("back.txt", b"1 a.png\n0.5 b.png\n".to_vec()),
        ("gone.txt", b"1 a.png\n2 z.png\n".to_vec()),
        ("few.txt", b"1\n2\n".to_vec()),
    ]);
    let with = |name: &str| {
        let timestamps = Some(folder.path().join(name));
        read(folder.path(), &SourceOptions { timestamps, ..SourceOptions::default() })
    };
    let (frames, warnings) = with("tum.txt").unwrap();
    assert_eq!(first_samples(&frames), [2, 3]);
    assert_eq!((frames[0].time_s, frames[1].time_s), (1.5, 2.25));
    assert!(warnings[0].contains("1 of 3 pictures have no time"), "{warnings:?}");
    let (frames, _) = with("euroc.csv").unwrap();
    assert_eq!(first_samples(&frames), [3, 1]);
    assert_eq!((frames[0].time_s, frames[1].time_s), (1.0, 1.5));
    assert_eq!(with("bare.txt").unwrap().0[2].time_s, 4.0);
    assert!(with("back.txt").unwrap_err().to_string().contains("line 2"));
    assert!(with("gone.txt").unwrap_err().to_string().contains("z.png, which is not there"));
    assert!(with("few.txt").unwrap_err().to_string().contains("2 times, but there are 3 pictures"));
    assert!(with("missing.txt").is_err());
}

#[test]
fn times_in_milliseconds_are_questioned() {
    let folder = folder(&[
        ("a.png", gray_png(1)),
        ("b.png", gray_png(2)),
        ("c.png", gray_png(3)),
        ("ms.txt", b"0\n33\n67\n".to_vec()),
        ("s.txt", b"0\n1\n2\n".to_vec()),
    ]);
    let warnings = |name: &str| {
        let timestamps = Some(folder.path().join(name));
        read(folder.path(), &SourceOptions { timestamps, ..SourceOptions::default() }).unwrap().1
    };
    let doubts = warnings("ms.txt");
    assert!(doubts.len() == 1 && doubts[0].contains("the frames are 34 s apart"), "{doubts:?}");
    assert!(warnings("s.txt").is_empty());
}

#[test]
fn euroc_layout_and_timestamps_in_file_names() {
    let folder = folder(&[
        (
            "mav0/cam0/data.csv",
            b"#timestamp [ns],filename\n5,1403715273262142976.png\n7,1403715273312143104.png\n".to_vec(),
        ),
        ("mav0/cam0/data/1403715273262142976.png", gray_png(1)),
        ("mav0/cam0/data/1403715273312143104.png", gray_png(2)),
    ]);
    let times = |place: &Path| -> Vec<f64> {
        let (frames, warnings) = read(place, &SourceOptions::default()).unwrap();
        assert!(warnings.is_empty());
        frames.iter().map(|f| f.time_s).collect()
    };
    assert_eq!(times(folder.path()), [5e-9, 7e-9]);
    let named = times(&folder.path().join("mav0/cam0/data"));
    assert!(
        (named[1] - named[0] - 0.050000128).abs() < 1e-6 && (named[0] - 1_403_715_273.262_143).abs() < 1e-6
    );
}

/// A small JPEG image with an EXIF segment that has `DateTimeOriginal` and its fraction.
fn jpeg_taken(second: u8, fraction: &str) -> Vec<u8> {
    let date = format!("2024:05:06 07:08:{second:02}\0");
    let mut tiff = b"II*\0\x08\0\0\0".to_vec();
    let entry = |tag: u16, kind: u16, count: u32, value: [u8; 4]| {
        let mut bytes = Vec::new();
        bytes.extend(tag.to_le_bytes());
        bytes.extend(kind.to_le_bytes());
        bytes.extend(count.to_le_bytes());
        bytes.extend(value);
        bytes
    };
    tiff.extend(1u16.to_le_bytes());
    tiff.extend(entry(0x8769, 4, 1, 26u32.to_le_bytes()));
    tiff.extend([0; 4]);
    tiff.extend(2u16.to_le_bytes());
    tiff.extend(entry(0x9003, 2, 20, 56u32.to_le_bytes()));
    let mut digits = [0; 4];
    digits[..fraction.len()].copy_from_slice(fraction.as_bytes());
    tiff.extend(entry(0x9291, 2, fraction.len() as u32 + 1, digits));
    tiff.extend([0; 4]);
    tiff.extend(date.as_bytes());
    let mut bytes = vec![0xff, 0xd8, 0xff, 0xe1];
    bytes.extend((tiff.len() as u16 + 8).to_be_bytes());
    bytes.extend(b"Exif\0\0");
    bytes.extend(tiff);
    bytes.extend(&include_bytes!("../data/ramp.jpg")[2..]);
    bytes
}

#[test]
fn exif_times_are_used_if_all_images_have_one() {
    let folder = folder(&[
        ("1.jpg", jpeg_taken(9, "25")),
        ("2.jpg", jpeg_taken(9, "75")),
        ("3.jpg", jpeg_taken(11, "")),
    ]);
    let (frames, warnings) = read(folder.path(), &SourceOptions::default()).unwrap();
    assert!(warnings.is_empty(), "{warnings:?}");
    let times: Vec<f64> = frames.iter().map(|f| f.time_s - frames[0].time_s).collect();
    assert!((times[1] - 0.5).abs() < 1e-6 && (times[2] - 1.75).abs() < 1e-6, "{times:?}");
    // 2024-05-06 07:08:09 UTC
    assert!((frames[0].time_s - 1_714_979_289.25).abs() < 1e-6, "{}", frames[0].time_s);

    // A list of fields that does not end as it should.
    let mut unended = jpeg_taken(13, "");
    unended[64..68].copy_from_slice(b"2024");
    fs::write(folder.path().join("4.jpg"), unended).unwrap();
    let (frames, warnings) = read(folder.path(), &SourceOptions::default()).unwrap();
    assert!(warnings.is_empty() && (frames[3].time_s - frames[0].time_s - 3.75).abs() < 1e-6, "{warnings:?}");

    fs::write(folder.path().join("5.jpg"), include_bytes!("../data/ramp.jpg")).unwrap();
    let (_, warnings) = read(folder.path(), &SourceOptions::default()).unwrap();
    assert!(warnings[0].contains("are assumed"), "{warnings:?}");
}

/// A JPEG file that was taken at a place, with fields of its own and metadata as text.
fn jpeg_at(
    second: u8,
    (latitude, south): (f64, bool),
    own: &[(exif::Tag, exif::Value)],
    xmp: &str,
) -> Vec<u8> {
    use exif::{Field, In, Rational, Tag, Value};
    let angle = |degrees: f64| {
        let whole = degrees.trunc();
        let minutes = ((degrees - whole) * 60.0 * 1e7).round() as u32;
        Value::Rational(vec![
            (whole as u32, 1).into(),
            (minutes, 10_000_000).into(),
            Rational { num: 0, denom: 1 },
        ])
    };
    let text = |text: &str| Value::Ascii(vec![text.as_bytes().to_vec()]);
    let mut fields = vec![
        (Tag::DateTimeOriginal, text(&format!("2024:05:06 07:08:{second:02}"))),
        (Tag::GPSLatitudeRef, text(if south { "S" } else { "N" })),
        (Tag::GPSLatitude, angle(latitude)),
        (Tag::GPSLongitudeRef, text("E")),
        (Tag::GPSLongitude, angle(16.3738)),
    ];
    fields.extend(own.iter().cloned());
    let fields: Vec<Field> =
        fields.into_iter().map(|(tag, value)| Field { tag, ifd_num: In::PRIMARY, value }).collect();
    let mut writer = exif::experimental::Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut tiff = std::io::Cursor::new(Vec::new());
    writer.write(&mut tiff, true).unwrap();
    let mut bytes = vec![0xff, 0xd8];
    let mut segment = |head: &[u8], body: &[u8]| {
        bytes.extend([0xff, 0xe1]);
        bytes.extend((2 + head.len() as u16 + body.len() as u16).to_be_bytes());
        bytes.extend(head);
        bytes.extend(body);
    };
    segment(b"Exif\0\0", tiff.get_ref());
    if !xmp.is_empty() {
        segment(b"http://ns.adobe.com/xap/1.0/\0", xmp.as_bytes());
    }
    bytes.extend(&include_bytes!("../data/ramp.jpg")[2..]);
    bytes
}

#[test]
fn positions_of_pictures_are_read_with_their_deviations() {
    use exif::{Tag, Value};
    let rational = |numerator: u32, denominator: u32| Value::Rational(vec![(numerator, denominator).into()]);
    let xmp = "<x:xmpmeta><rdf:Description drone-dji:RtkStdLon=\"0.01150\" drone-dji:RtkStdLat=\"+0.02\"/></x:xmpmeta>";
    let folder = folder(&[
        ("3.jpg", jpeg_at(13, (48.2084, true), &[], xmp)),
        ("1.jpg", jpeg_at(9, (48.2082, false), &[(Tag::GPSAltitude, rational(1805, 10))], "")),
        ("2.jpg", jpeg_at(11, (48.2083, false), &[(Tag::GPSHPositioningError, rational(7, 2))], "")),
        ("4.jpg", jpeg_at(15, (48.2085, false), &[(Tag::GPSDOP, rational(8, 10))], "")),
        ("5.jpg", jpeg_taken(17, "")),
    ]);
    let (fixes, warnings) = odograph_video::picture_fixes(folder.path()).unwrap();
    let sigmas: Vec<[f64; 2]> = fixes
        .iter()
        .map(|fix| [fix.covariance_m2[(0, 0)].sqrt(), fix.covariance_m2[(1, 1)].sqrt()])
        .collect();
    let stated = [[3.0, 3.0], [3.5, 3.5], [0.0115, 0.02], [2.0, 2.0]];
    assert!(sigmas.iter().zip(stated).all(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]) < 1e-9), "{sigmas:?}");
    let latitudes: Vec<f64> = fixes.iter().map(|fix| fix.place.latitude_rad.to_degrees()).collect();
    let expected = [48.2082, 48.2083, -48.2084, 48.2085];
    assert!(latitudes.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-8), "{latitudes:?}");
    assert_eq!(fixes.iter().map(|fix| fix.altitude_m).collect::<Vec<_>>(), [Some(180.5), None, None, None]);
    assert!(warnings.len() == 1 && warnings[0].contains("1 of 5 pictures have no position"), "{warnings:?}");
    // Their times are those of the frames of the same folder.
    let (frames, _) = read(folder.path(), &SourceOptions::default()).unwrap();
    let times = |of: &mut dyn Iterator<Item = f64>| of.take(4).collect::<Vec<_>>();
    assert_eq!(
        times(&mut fixes.iter().map(|fix| fix.time_s)),
        times(&mut frames.iter().map(|frame| frame.time_s))
    );
}

#[test]
fn deep_transparent_and_colored_pictures() {
    use png::{BitDepth, ColorType};
    let one = |bytes: Vec<u8>, color: bool| {
        let folder = folder(&[("one.png", bytes)]);
        let options = SourceOptions { color, ..SourceOptions::default() };
        read(&folder.path().join("one.png"), &options).unwrap().0.remove(0)
    };
    let deep = one(png(ColorType::Grayscale, BitDepth::Sixteen, 2, 1, &[0x12, 0x92, 0x12, 0x93]), false);
    assert_eq!(deep.gray.samples(), [0x12, 0x13]);
    let gray_alpha =
        one(png(ColorType::GrayscaleAlpha, BitDepth::Eight, 3, 1, &[200, 255, 200, 0, 200, 51]), false);
    assert_eq!(gray_alpha.gray.samples(), [200, 0, 40]);
    let rgba = one(png(ColorType::Rgba, BitDepth::Eight, 2, 1, &[255, 0, 0, 255, 255, 255, 255, 0]), true);
    assert_eq!(rgba.gray.samples(), [76, 0]);
    assert_eq!(rgba.rgb().pixel(0, 0), [255, 0, 0]);
    let deep_rgba =
        one(png(ColorType::Rgba, BitDepth::Sixteen, 1, 1, &[255, 255, 0, 0, 0, 0, 255, 255]), false);
    assert_eq!(deep_rgba.gray.samples(), [76]);
    assert_eq!(deep_rgba.time_s, 0.0);
}

#[test]
fn tiff_pictures() {
    let mut bytes = std::io::Cursor::new(Vec::new());
    tiff::encoder::TiffEncoder::new(&mut bytes)
        .unwrap()
        .write_image::<tiff::encoder::colortype::Gray16>(2, 1, &[0x1293, 0xffff])
        .unwrap();
    let folder = folder(&[("a.tif", bytes.into_inner())]);
    assert_eq!(read(folder.path(), &SourceOptions::default()).unwrap().0[0].gray.samples(), [0x13, 255]);
}

#[test]
fn invalid_sources_fail_with_one_sentence() {
    assert!(sentence(Path::new("/nowhere/at/all.mp4")).ends_with("there is no such file or folder"));
    assert!(sentence(folder(&[]).path()).contains("the folder is empty; give a video, a folder of pictures"));
    let texts = folder(&[("b.txt", b"x".to_vec()), ("a.txt", b"x".to_vec())]);
    assert!(sentence(texts.path()).contains("only other things such as a.txt; give a video"));
    let outer = folder(&[("left/1.png", gray_png(0)), ("readme", b"x".to_vec())]);
    assert!(sentence(outer.path()).ends_with("give the folder left that is in it"));

    let sizes = folder(&[
        ("1.png", gray_png(0)),
        ("2.png", png(png::ColorType::Grayscale, png::BitDepth::Eight, 3, 2, &[0; 6])),
    ]);
    let text = sentence(sizes.path());
    assert!(text.contains("the picture 2.png has 3x2 pixels, the first has 2x2"), "{text}");

    let broken =
        folder(&[("1.png", gray_png(0)), ("2.png", gray_png(0)[..40].to_vec()), ("3.png", b"no".to_vec())]);
    assert!(sentence(broken.path()).contains("2.png: the PNG picture cannot be decoded"));
    let cut = folder(&[("1.jpg", include_bytes!("../data/ramp.jpg")[..210].to_vec())]);
    assert!(sentence(cut.path()).ends_with("1.jpg: the JPEG picture is cut off"));
}

#[test]
fn files_with_a_wrong_extension_fail_with_a_reason() {
    let random: Vec<u8> = (0u32..5000).map(|n| (n.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    let mp4 = |bytes: &[u8]| [b"\0\0\0\x10ftypisom\0\0\0\0", bytes].concat();
    let files = [
        ("empty.mp4", Vec::new(), "the file is empty"),
        ("random.mp4", random.clone(), "not a picture or video of a kind known here"),
        ("notes.mp4", b"gone to lunch".to_vec(), "this is a text file, not a recording; give a video"),
        ("times.csv", b"time_s\n0\n1\n".to_vec(), "this is a text file, not a recording; give a video"),
        ("letter.pdf", b"%PDF-1.7\n".to_vec(), "this is a PDF document, not a recording; give a video"),
        (
            "drive.zip",
            b"PK\x03\x04\x14".to_vec(),
            "a ZIP archive or an office document, not a recording; unpack it",
        ),
        ("nothing.mp4", mp4(b""), "there is no index (moov box)"),
        (
            "unfinished.mp4",
            mp4(&[&b"\0\0\x10\0mdat"[..], &random].concat()),
            "the index (the moov box) is missing",
        ),
        ("soundless.mp4", mp4(b"\0\0\0\x08moov"), "there is no video in this file"),
        ("hollow.mkv", vec![0x1a, 0x45, 0xdf, 0xa3, 0x80, 0x18, 0x53, 0x80, 0x67, 0x80], "there is no track"),
        ("hollow.avi", b"RIFF\0\0\0\0AVI ".to_vec(), "there is no video in this AVI file"),
        ("headless.h264", vec![0, 0, 0, 1, 0x65, 0x88, 1, 2, 3, 4], "no frame of this H.264 video"),
        ("frameless.y4m", b"YUV4MPEG2 W2 H2\n".to_vec(), "there is no frame in it"),
        ("huge.pgm", b"P5 99999 99999 255\n".to_vec(), "larger than"),
    ];
    for (name, bytes, expected) in files {
        let folder = folder(&[(name, bytes)]);
        let text = sentence(&folder.path().join(name));
        assert!(text.contains(expected), "{text}");
    }
}

#[test]
fn a_truncated_video_yields_its_complete_frames() {
    let whole =
        fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/h264_fragmented.mp4")).unwrap();
    let (mut most, mut warned) = (0, 0);
    for cut in (0..whole.len()).rev().step_by(97) {
        let folder = folder(&[("cut.mp4", whole[..cut].to_vec())]);
        match read(&folder.path().join("cut.mp4"), &SourceOptions::default()) {
            Ok((frames, warnings)) => {
                assert!(frames.len() <= 12);
                most = most.max(frames.len());
                warned += usize::from(!warnings.is_empty());
            }
            Err(error) => assert!(!error.to_string().contains('\n')),
        }
    }
    assert!(most >= 6 && warned > 5, "{most} {warned}");
}
