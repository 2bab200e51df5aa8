//! `stipple export`: the map of a run out of its store, as a file that viewers open.

use crate::output::export::{export as write, Form, Request};
use crate::run::status::{print_err, print_out};
use std::path::{Path, PathBuf};
use stipple_drivers::{Fault, FaultKind};

/// Damaged blocks that are named one by one.
const DAMAGED_NAMED: usize = 8;

#[derive(clap::Args)]
pub struct Args {
    /// Folder of the run, as it was given to --out; its map store is DIR/map, and a run may be writing to it
    dir: PathBuf,
    /// File to write; its ending says what: .ply as 3DGS viewers read it, or .spz, less than a third of the size and with y up [default: DIR/export.ply]
    #[arg(long, value_name = "FILE.ply|FILE.spz")]
    out: Option<PathBuf>,
    /// Number of the run, where the store has several [default: the newest that has a map]
    #[arg(long, value_name = "N")]
    run: Option<u32>,
    /// Only the N most important Gaussians: opacity times the area of their two largest deviations
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    most: Option<u64>,
    /// Only Gaussians within these bounds, m
    #[arg(long, value_name = "X0,Y0,Z0,X1,Y1,Z1", value_parser = region, allow_hyphen_values = true)]
    region: Option<[[f32; 3]; 2]>,
}

pub fn export(args: &Args) -> Result<(), Fault> {
    let to = args.out.clone().unwrap_or_else(|| args.dir.join("export.ply"));
    let form = form_of(&to)?;
    let folder = args.dir.join("map");
    if !folder.is_dir() {
        let fix = "name the folder of a run that kept its map there";
        return Err(Fault::new(FaultKind::NoInput, folder.display().to_string(), "there is no map store", fix));
    }
    let request = Request { run: args.run, most: args.most, region: args.region };
    let done = write(&folder, &to, form, &request)?;
    print_out(format_args!(
        "{}: {} Gaussians of {} blocks of run {}, {} bytes; runs in the store: {}",
        to.display(),
        done.gaussians,
        done.blocks,
        done.run,
        done.bytes,
        done.runs
    ));
    if !done.damaged.is_empty() {
        let named: Vec<String> = done.damaged.iter().take(DAMAGED_NAMED).map(u32::to_string).collect();
        let more = if done.damaged.len() > DAMAGED_NAMED { ", .." } else { "" };
        let (n, of) = (done.damaged.len(), done.damaged.len() + done.blocks);
        let list = named.join(", ");
        print_err(format_args!("stipple: note: {n} of {of} blocks are damaged and left out: {list}{more}"));
    }
    Ok(())
}

fn form_of(to: &Path) -> Result<Form, Fault> {
    match to.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
        Some("ply") => Ok(Form::Ply),
        Some("spz") => Ok(Form::Spz),
        _ => {
            let what = "has an ending that names no form of a map";
            Err(Fault::new(FaultKind::Usage, to.display().to_string(), what, "call it .ply or .spz"))
        }
    }
}

/// Parses the least x, y and z, and the largest.
fn region(text: &str) -> Result<[[f32; 3]; 2], String> {
    let numbers: Result<Vec<f32>, _> = text.split(',').map(|n| n.trim().parse::<f32>()).collect();
    let [x0, y0, z0, x1, y1, z1] = numbers.ok().and_then(|n| n.try_into().ok()).ok_or("must be six numbers")?;
    let region = [[x0, y0, z0], [x1, y1, z1]];
    match region[0].iter().zip(region[1]).all(|(least, most)| *least < most) {
        true => Ok(region),
        false => Err("each of the first three must be less than the one three behind it".into()),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_region_is_six_numbers_in_order() {
        assert_eq!(region("-1,0, 0.5,1,2,3"), Ok([[-1.0, 0.0, 0.5], [1.0, 2.0, 3.0]]));
        for wrong in ["", "1,2,3", "0,0,0,1,1,a", "0,0,0,1,1,0", "0,0,0,1,1,1,1", "0,0,0,1,1,nan"] {
            assert!(region(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn the_ending_says_the_form() {
        assert_eq!(["a.ply", "b.SPZ"].map(|n| form_of(Path::new(n)).unwrap()), [Form::Ply, Form::Spz]);
        assert_eq!(form_of(Path::new("map")).unwrap_err().kind, FaultKind::Usage);
    }
}
