//! `odograph board`: a calibration board to print.

mod page;
mod paper;
mod pdf;
mod png;
mod svg;

use crate::{Outcome, console, files};
use odograph::error::{Error, Result};
use odograph_calibration::Board;
use page::Page;
use paper::Paper;
use std::path::{Path, PathBuf};

/// Make a calibration board to print.
///
/// It is at true size, with a ruler to measure the print by.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct BoardArguments {
    /// The board to print, such as chessboard:9x6:25mm; the kinds are below.
    #[arg(long, value_name = "BOARD")]
    board: Board,
    /// The file to write; its extension is the format: .pdf, .svg or .png.
    ///
    /// [default: board.pdf, with a number if that exists]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Paper: a5 to a0, letter, legal, tabloid, or a size such as 500x700mm.
    ///
    /// [default: the smallest of a4 to a0 that fits]
    #[arg(long, value_name = "PAPER")]
    paper: Option<Paper>,
    /// Resolution of a PNG, pixels per inch. [default: 300]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(50..=2400))]
    dpi: Option<u16>,
    /// Overwrite the file if it exists.
    #[arg(long)]
    force: bool,
    /// Say nothing but errors.
    #[arg(short, long)]
    quiet: bool,
}

const EXAMPLES: &str = "\
Boards:
  chessboard:9x6:25mm            inner corners, side of a square; must always be seen whole
  charuco:8x11:20mm              squares, side of a square; parts of it are enough
  charuco:8x11:20mm:15mm:4x4_50  the same with side and dictionary of its markers
  aprilgrid:6x6:88mm:26.4mm      tags, side of a tag, gap: Kalibr's target; parts of it are enough
  circles:7x5:20mm               discs, distance of two in a row
  asymmetric-circles:4x11:20mm   discs, half the distance of two in a row

Print at 100 %, without fitting to the page, and measure the ruler. Glue the print to something
flat. If the ruler measures 98 mm, every length of the board is 0.98 of what was asked for: give
those lengths when calibrating.

Examples:
  odograph board --board charuco:8x11:20mm -o board.pdf
  odograph board --board chessboard:9x6:40mm --paper a2 -o board.svg";

/// Default resolution of a PNG, pixels per inch.
const DPI: u16 = 300;

/// The format, by the extension of the file.
#[derive(Debug, Clone, Copy)]
enum BoardFormat {
    Pdf,
    Svg,
    Png,
}

/// Runs the command.
pub fn board(arguments: BoardArguments) -> Result<Outcome> {
    let BoardArguments { board, output, paper, dpi, force, quiet } = &arguments;
    let output = &output.clone().unwrap_or_else(|| files::free_beside("board", ".pdf"));
    let format = format(output)?;
    if dpi.is_some() && !matches!(format, BoardFormat::Png) {
        return Err(Error::usage(format!(
            "--dpi is for .png; {} has no pixels, and is at true size at any resolution",
            output.display()
        )));
    }
    files::check_output_file(output, *force)?;
    let page = Page::new(board, *paper)?;
    let bytes = match format {
        BoardFormat::Pdf => pdf::pdf(&page),
        BoardFormat::Svg => svg::svg(&page).into_bytes(),
        BoardFormat::Png => png::png(&page, dpi.unwrap_or(DPI))?,
    };
    let _made = files::MadeFolders::of_file(output)?;
    files::write(output, &bytes)?;
    if !quiet {
        console::print(&format!(
            "{}: {board}, {} on {}\nPrint it at 100 %, without fitting to the page; the ruler must then measure {} mm\n",
            console::name(output),
            page.pattern_text(),
            page.paper_text(),
            page.ruler_mm(),
        ))?;
    }
    Ok(Outcome::Done)
}

fn format(output: &Path) -> Result<BoardFormat> {
    let ending = output.extension().map(|ending| ending.to_string_lossy().to_ascii_lowercase());
    match ending.as_deref() {
        Some("pdf") => Ok(BoardFormat::Pdf),
        Some("svg") => Ok(BoardFormat::Svg),
        Some("png") => Ok(BoardFormat::Png),
        _ => Err(Error::usage(format!(
            "{} does not end in .pdf, .svg or .png, which decides what is written",
            output.display()
        ))),
    }
}
