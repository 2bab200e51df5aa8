//! Whether a JPEG is whole, where its decoder does not tell: `zune-jpeg` forgives a last row that is cut, and stops with
//! success at a marker inside the scan of a baseline image whose first scan has all components. The rows after that are left
//! as they were, which are those of the image before. It panics at colours that are sampled more finely than brightness.
//! ITU-T T.81, annex B and F.2.2.5.

const START_OF_FRAME: std::ops::RangeInclusive<u8> = 0xc0..=0xc2;
const PROGRESSIVE: u8 = 0xc2;
const END_OF_IMAGE: u8 = 0xd9;
const START_OF_SCAN: u8 = 0xda;

/// Refuses a JPEG without its end, one with a marker inside the scan of all components, and one whose colours are sampled as
/// no camera does. What else is wrong, its decoder says.
pub fn check_whole(jpeg: &[u8]) -> Result<(), &'static str> {
    // Nothing inside coded pixels looks like a marker. Padding may follow the end.
    if !jpeg.windows(2).rev().any(|w| w == [0xff, END_OF_IMAGE]) {
        return Err("it is cut: there is no marker of its end");
    }
    let (mut rest, mut components) = (&jpeg[2.min(jpeg.len())..], None);
    while let [first, marker, high, low, body @ ..] = rest {
        let length = usize::from(u16::from_be_bytes([*high, *low])).max(2) - 2;
        if *first != 0xff || matches!(marker, 0 | 0xff) {
            rest = &rest[1..];
            continue;
        }
        if START_OF_FRAME.contains(marker) {
            // A progressive image has many scans, and is decoded as a whole.
            components = body.get(5).filter(|_| *marker != PROGRESSIVE);
            let mut samplings = body.get(6..length).unwrap_or_default().chunks_exact(3).map(|component| component[1]);
            let first = samplings.next();
            if !samplings.all(|s| s == 0x11 || Some(s) == first) {
                return Err("its colours are sampled more finely than its brightness");
            }
        }
        rest = body.get(length..).unwrap_or_default();
        if *marker == START_OF_SCAN {
            let is_whole = components.is_some() && body.first() == components;
            // Between coded pixels stand restarts alone; a zero makes 0xff a number, and 0xff may fill.
            let is_inside = |w: &&[u8]| w[0] == 0xff && !matches!(w[1], 0 | 0xd0..=0xd7 | 0xff);
            return match rest.windows(2).find(is_inside) {
                Some([_, marker]) if is_whole && *marker != END_OF_IMAGE => Err("a marker breaks off its only scan"),
                _ => Ok(()),
            };
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jpeg::flat;

    #[test]
    fn a_cut_jpeg_and_one_whose_scan_a_marker_breaks_off_are_refused_and_padding_is_not() {
        let jpeg = flat(16, 16, &[10, 20, 30, 40]);
        assert_eq!(check_whole(&jpeg), Ok(()));
        assert_eq!(check_whole(&[&jpeg[..], &[0; 9], &[0xff, START_OF_SCAN]].concat()), Ok(()));
        assert!(check_whole(&jpeg[..jpeg.len() - 2]).is_err());
        let scan = jpeg.windows(2).position(|w| w == [0xff, START_OF_SCAN]).expect("it has one");
        let twice = [&jpeg[..jpeg.len() - 4], &jpeg[scan..]].concat();
        let comment = [&jpeg[..jpeg.len() - 4], &[0xff, 0xfe, 0, 2], &jpeg[jpeg.len() - 4..]].concat();
        assert_eq!([twice, comment].map(|jpeg| check_whole(&jpeg)), [Err("a marker breaks off its only scan"); 2]);
        let frame = jpeg.windows(2).position(|w| w == [0xff, 0xc0]).expect("it has one");
        let mut finer = jpeg.clone();
        // Three components, the second 2 x 4 times as fine.
        finer.splice(frame..frame + 13, [0xff, 0xc0, 0, 17, 8, 0, 16, 0, 16, 3, 1, 0x11, 0, 2, 0x24, 1, 3, 0x11, 1]);
        assert_eq!(check_whole(&finer), Err("its colours are sampled more finely than its brightness"));
        for end in 0..jpeg.len() {
            let _ = check_whole(&jpeg[..end]);
        }
    }
}
