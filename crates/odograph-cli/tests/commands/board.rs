//! Black-box tests of `odograph board`: the printed size is exact, and invalid input is refused.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn odograph(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_odograph")).args(arguments).output().unwrap()
}

fn board(folder: &Path, name: &str, more: &[&str]) -> Output {
    let path = folder.join(name);
    odograph(&[&["board", "-o", path.to_str().unwrap()], more].concat())
}

/// Samples, size, and pixels per metre of a gray PNG.
fn png(path: &Path) -> (Vec<u8>, (usize, usize), u32) {
    let mut reader = png::Decoder::new(std::io::BufReader::new(fs::File::open(path).unwrap()));
    reader.set_transformations(png::Transformations::IDENTITY);
    let mut reader = reader.read_info().unwrap();
    let mut samples = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut samples).unwrap();
    let info = reader.info();
    let resolution = info.pixel_dims.unwrap();
    assert_eq!(resolution.unit, png::Unit::Meter);
    assert_eq!(resolution.xppu, resolution.yppu);
    (samples, (info.width as usize, info.height as usize), resolution.xppu)
}

#[test]
fn the_png_has_the_exact_size_of_the_board() {
    let temporary = tempfile::tempdir().unwrap();
    // 254 dpi are ten pixels per millimetre.
    let done = board(temporary.path(), "b.png", &["--board", "chessboard:9x6:25mm", "--dpi", "254"]);
    assert_eq!(done.status.code(), Some(0), "{done:?}");
    let message = String::from_utf8(done.stdout).unwrap();
    assert!(message.contains("pattern 250 x 175 mm on A4 paper (297 x 210 mm), landscape"), "{message}");
    assert!(message.contains("100 mm"), "{message}");
    let (samples, (width, height), pixels_per_metre) = png(&temporary.path().join("b.png"));
    assert_eq!((width, height, pixels_per_metre), (2970, 2100, 10_000));
    // The first row of squares, 250 pixels each, between its outer ends.
    let top = (0..height).find(|y| samples[y * width..][..width].contains(&0)).unwrap();
    let row = &samples[(top + 100) * width..][..width];
    let left = row.iter().position(|sample| *sample < 128).unwrap();
    for square in 0..10 {
        for (at, gray) in
            [(2, if square % 2 == 0 { 0 } else { 255 }), (247, if square % 2 == 0 { 0 } else { 255 })]
        {
            assert_eq!(row[left + 250 * square + at], gray, "square {square}");
        }
    }
    // The ruler starts 21 mm above the lower edge; in its topmost millimetre there are only the
    // longest ticks, one every 10 mm.
    let row = &samples[(height - 205) * width..][..width];
    let mut ticks: Vec<usize> = (0..width).filter(|x| row[*x] < 160).collect();
    ticks.dedup_by(|next, before| *next <= *before + 2);
    assert_eq!(ticks.len(), 11, "{ticks:?}");
    for (number, tick) in ticks.iter().enumerate() {
        assert!(tick.abs_diff(ticks[0] + 100 * number) <= 1, "{ticks:?}");
    }
}

#[test]
fn svg_and_pdf_have_exact_paper_and_board_sizes() {
    let temporary = tempfile::tempdir().unwrap();
    let asked = ["--board", "charuco:8x11:20mm", "-q"];
    for name in ["b.svg", "b.pdf"] {
        let done = board(temporary.path(), name, &asked);
        assert_eq!(done.status.code(), Some(0), "{done:?}");
        assert!(done.stdout.is_empty());
    }
    let svg = fs::read_to_string(temporary.path().join("b.svg")).unwrap();
    assert!(svg.contains("width=\"210mm\" height=\"297mm\" viewBox=\"0 0 210 297\""));
    // Black squares have 20 mm, marker cells 15 mm / 6; the board is centred on the page.
    assert!(svg.contains("d=\"M25 ") && svg.contains("h20v20h-20z") && svg.contains("v2.5h"), "{svg}");
    assert!(svg.contains("odograph calibrate VIDEO --board charuco:8x11:20mm:15mm:4x4_50 -o camera.yaml"));
    assert!(svg.contains(">100 mm<"));
    let pdf = fs::read(temporary.path().join("b.pdf")).unwrap();
    assert!(pdf.starts_with(b"%PDF-"));
    let pdf = String::from_utf8_lossy(&pdf);
    // A4 in points, and squares of 20 mm.
    assert!(pdf.contains("/MediaBox [0 0 595.27") && pdf.contains("841.88"), "{pdf}");
    assert!(pdf.contains("/PrintScaling /None"));
    assert!(pdf.contains("56.692") && pdf.contains("(100 mm) Tj"), "{pdf}");
    assert!(pdf.contains("--board charuco:8x11:20mm:15mm:4x4_50"));
    // The same board gives the same bytes.
    assert_eq!(board(temporary.path(), "again.pdf", &asked).status.code(), Some(0));
    assert_eq!(
        fs::read(temporary.path().join("again.pdf")).unwrap(),
        fs::read(temporary.path().join("b.pdf")).unwrap()
    );
}

#[test]
fn unprintable_boards_are_refused_in_one_sentence() {
    let temporary = tempfile::tempdir().unwrap();
    for (name, more, reason) in [
        ("b.pdf", &["--board", "charuco:8x11:30mm", "--paper", "a4"][..], "does not fit on A4 paper"),
        (
            "b.pdf",
            &["--board", "charuco:8x11:30mm", "--paper", "a4"],
            "charuco:8x11:24mm:18mm:4x4_50 or --paper a3",
        ),
        ("b.pdf", &["--board", "chessboard:9x6:25"], "not a length with its unit"),
        ("b.pdf", &["--board", "chessboard:9x6:25mm", "--paper", "a9"], "`a9` is no paper"),
        ("b.jpg", &["--board", "chessboard:9x6:25mm"], "does not end in .pdf, .svg or .png"),
        ("b.png", &["--board", "aprilgrid:6x6:88mm", "--dpi", "2400"], "take a lower --dpi, or a .pdf"),
        ("/dev/null/b.pdf", &["--board", "chessboard:9x6:25mm"], "cannot be made"),
    ] {
        let refused = board(temporary.path(), name, more);
        assert!([Some(2), Some(3)].contains(&refused.status.code()), "{refused:?}");
        let said = String::from_utf8(refused.stderr).unwrap();
        assert!(said.contains(reason), "{said}");
    }
    assert_eq!(fs::read_dir(temporary.path()).unwrap().count(), 0);
    let asked = ["--board", "circles:7x5:20mm"];
    assert_eq!(board(temporary.path(), "b.svg", &asked).status.code(), Some(0));
    let refused = board(temporary.path(), "b.svg", &asked);
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8(refused.stderr).unwrap().contains("--force"));
    assert_eq!(
        board(temporary.path(), "b.svg", &["--board", "circles:7x5:20mm", "--force"]).status.code(),
        Some(0)
    );
}
