//! Charts as inline SVG: lines, steps of a histogram, horizontal bars. Colours and fonts are
//! classes of the page's style sheet, so that a chart follows light and dark.

use std::fmt::Write;

const WIDTH: f64 = 560.0;
const HEIGHT: f64 = 300.0;
const LEFT: f64 = 56.0;
const RIGHT: f64 = 16.0;
/// Right margin that holds the names of levels.
const RIGHT_NAMED: f64 = 56.0;
const TOP: f64 = 46.0;
const BOTTOM: f64 = 40.0;
/// Points drawn per series; more cannot be told apart at this width.
const POINTS_MAX: usize = 1200;

/// One line of a chart. `ink` 1.. picks the colour of the style sheet.
#[derive(Clone, Debug)]
pub struct Series<'a> {
    pub name: &'a str,
    pub ink: u8,
    /// Draws each point; for curves of few samples.
    pub dots: bool,
    pub points: Vec<(f64, f64)>,
}

impl<'a> Series<'a> {
    pub fn line(name: &'a str, ink: u8, points: Vec<(f64, f64)>) -> Series<'a> {
        Series { name, ink, dots: false, points }
    }

    pub fn dots(name: &'a str, ink: u8, points: Vec<(f64, f64)>) -> Series<'a> {
        Series { name, ink, dots: true, points }
    }
}

#[derive(Clone, Debug, Default)]
pub struct Chart<'a> {
    pub title: &'a str,
    /// With unit: "run time, s".
    pub x: &'a str,
    pub y: &'a str,
    pub series: Vec<Series<'a>>,
    /// Horizontal lines with a name, such as percentiles.
    pub levels: Vec<(&'a str, f64)>,
    /// One metre is as long up as along: for maps seen from above.
    pub equal: bool,
    /// The vertical axis starts at zero.
    pub from_zero: bool,
    /// Upper end of the vertical axis; what is above is cut and said so.
    pub y_max: Option<f64>,
}

/// A linear map from data to the drawing along one axis.
#[derive(Clone, Copy, Debug)]
struct Scale {
    from: f64,
    to: f64,
    start: f64,
    end: f64,
}

impl Scale {
    fn at(&self, v: f64) -> f64 {
        self.start + (v - self.from) / (self.to - self.from) * (self.end - self.start)
    }
}

impl Chart<'_> {
    fn right(&self) -> f64 {
        WIDTH - if self.levels.is_empty() { RIGHT } else { RIGHT_NAMED }
    }

    /// `None` when no series has a point.
    pub fn svg(&self) -> Option<String> {
        let lines: Vec<Vec<(f64, f64)>> = self.series.iter().map(|s| thinned(&s.points, self.equal)).collect();
        let (xs, ys) = self.scales(&lines)?;
        let mut svg = String::new();
        let _ = write!(svg, r#"<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{}">"#, escape(self.title));
        text(&mut svg, "title", (0.0, 14.0), "start", self.title);
        self.legend(&mut svg);
        self.axes(&mut svg, xs, ys);
        for (series, line) in self.series.iter().zip(&lines) {
            draw_line(&mut svg, series, line, xs, ys);
        }
        for (name, v) in self.levels.iter().filter(|(_, v)| (ys.from..=ys.to).contains(v)) {
            let (x, y) = (self.right(), ys.at(*v));
            let _ = write!(svg, r#"<path class="level" d="M{LEFT} {y:.1}H{x}"/>"#);
            text(&mut svg, "tick", (x + 5.0, y + 4.0), "start", name);
        }
        self.say_what_is_cut(&mut svg, ys);
        svg.push_str("</svg>");
        Some(svg)
    }

    fn scales(&self, lines: &[Vec<(f64, f64)>]) -> Option<(Scale, Scale)> {
        let (mut x0, mut x1) = range(lines.iter().flatten().map(|p| p.0))?;
        let (mut y0, mut y1) = range(lines.iter().flatten().map(|p| p.1))?;
        if let Some((l0, l1)) = range(self.levels.iter().map(|l| l.1)) {
            (y0, y1) = (y0.min(l0), y1.max(l1));
        }
        if self.from_zero {
            y0 = y0.min(0.0);
        }
        if let Some(max) = self.y_max {
            y1 = y1.min(max);
        }
        let (wide, high) = (self.right() - LEFT, HEIGHT - TOP - BOTTOM);
        (y0, y1) = widened(y0, y1, if self.from_zero { 0.0 } else { 0.06 }, 0.06);
        if self.equal {
            (x0, x1) = widened(x0, x1, 0.06, 0.06);
            let per_px = ((x1 - x0) / wide).max((y1 - y0) / high);
            (x0, x1) = centred(x0, x1, per_px * wide);
            (y0, y1) = centred(y0, y1, per_px * high);
        } else {
            (x0, x1) = widened(x0, x1, 0.0, 0.0);
        }
        let x = Scale { from: x0, to: x1, start: LEFT, end: self.right() };
        Some((x, Scale { from: y0, to: y1, start: HEIGHT - BOTTOM, end: TOP }))
    }

    fn say_what_is_cut(&self, svg: &mut String, ys: Scale) {
        let above = self.series.iter().flat_map(|s| &s.points).map(|p| p.1).filter(|y| y.is_finite() && *y > ys.to);
        let (count, most) = above.fold((0, 0.0f64), |(n, most), y| (n + 1, most.max(y)));
        if count > 0 {
            let said = format!("{count} above the chart, at most {most:.0} {}", self.y);
            text(svg, "tick", (LEFT, 34.0), "start", &said);
        }
    }

    fn legend(&self, svg: &mut String) {
        if self.series.len() < 2 {
            return;
        }
        let mut x = LEFT;
        for s in self.series.iter().filter(|s| !s.points.is_empty() && !s.name.is_empty()) {
            let _ = write!(svg, r#"<path class="line ink{}" d="M{x} 30h16"/>"#, s.ink);
            text(svg, "tick", (x + 21.0, 34.0), "start", s.name);
            // 6.2 px a character: the mean advance of a 12 px sans-serif face.
            x += 21.0 + 6.2 * s.name.chars().count() as f64 + 18.0;
        }
    }

    fn axes(&self, svg: &mut String, xs: Scale, ys: Scale) {
        let (floor, right) = (HEIGHT - BOTTOM, self.right());
        let (labels, step) = ticks(ys, 5);
        for v in labels {
            let y = ys.at(v);
            let _ = write!(svg, r#"<path class="grid" d="M{LEFT} {y:.1}H{right}"/>"#);
            text(svg, "tick", (LEFT - 7.0, y + 4.0), "end", &number(v, step));
        }
        let (labels, step) = ticks(xs, 8);
        for v in labels {
            let x = xs.at(v);
            let _ = write!(svg, r#"<path class="axis" d="M{x:.1} {floor}v4"/>"#);
            text(svg, "tick", (x, floor + 17.0), "middle", &number(v, step));
        }
        let _ = write!(svg, r#"<path class="axis" d="M{LEFT} {floor}H{right}"/>"#);
        text(svg, "tick", (right, HEIGHT - 4.0), "end", self.x);
        text(svg, "tick", (right, 14.0), "end", self.y);
    }
}

fn draw_line(svg: &mut String, series: &Series, line: &[(f64, f64)], xs: Scale, ys: Scale) {
    if line.is_empty() {
        return;
    }
    // What lies above a cut axis is drawn along its edge.
    let place = |p: &(f64, f64)| (xs.at(p.0), ys.at(p.1).clamp(TOP, HEIGHT - BOTTOM));
    let _ = write!(svg, r#"<path class="line ink{}" d=""#, series.ink);
    for (i, p) in line.iter().enumerate() {
        let (x, y) = place(p);
        let _ = write!(svg, "{}{x:.1} {y:.1}", if i == 0 { "M" } else { "L" });
    }
    svg.push_str(r#""/>"#);
    if series.dots {
        for p in line {
            let (x, y) = place(p);
            let _ = write!(svg, r#"<circle class="dot ink{}" cx="{x:.1}" cy="{y:.1}" r="2.6"/>"#, series.ink);
        }
    }
}

/// Horizontal bars with a name before and a value behind each.
pub fn bars(title: &str, unit: &str, rows: &[(String, f64, String)]) -> Option<String> {
    const ROW: f64 = 22.0;
    const NAMES: f64 = 150.0;
    const VALUES: f64 = 180.0;
    let (_, most) = range(rows.iter().map(|r| r.1))?;
    let height = 34.0 + ROW * rows.len() as f64;
    let mut svg = String::new();
    let _ = write!(svg, r#"<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{}">"#, escape(title));
    text(&mut svg, "title", (0.0, 14.0), "start", title);
    text(&mut svg, "tick", (WIDTH - RIGHT, 14.0), "end", unit);
    for (i, (name, value, note)) in rows.iter().enumerate() {
        let y = 28.0 + ROW * i as f64;
        let long = ((WIDTH - NAMES - VALUES) * value / most.max(f64::MIN_POSITIVE)).max(1.0);
        text(&mut svg, "tick", (NAMES - 8.0, y + 11.0), "end", name);
        let _ = write!(svg, r#"<rect class="bar ink1" x="{NAMES}" y="{y}" width="{long:.1}" height="15" rx="1.5"/>"#);
        text(&mut svg, "tick", (NAMES + long + 6.0, y + 11.0), "start", note);
    }
    svg.push_str("</svg>");
    Some(svg)
}

/// The outline of a histogram of `values` below `max`, `bins` equal bins; the last bin takes the rest.
pub fn histogram(values: &[f64], max: f64, bins: usize) -> Vec<(f64, f64)> {
    let mut counts = vec![0usize; bins];
    for v in values.iter().filter(|v| v.is_finite()) {
        counts[((v / max * bins as f64) as usize).min(bins - 1)] += 1;
    }
    let edge = |i: usize| max * i as f64 / bins as f64;
    let mut outline = vec![(0.0, 0.0)];
    for (i, &n) in counts.iter().enumerate() {
        outline.extend([(edge(i), n as f64), (edge(i + 1), n as f64)]);
    }
    outline.push((max, 0.0));
    outline
}

fn text(svg: &mut String, class: &str, (x, y): (f64, f64), anchor: &str, words: &str) {
    let words = escape(words);
    let _ = write!(svg, r#"<text class="{class}" x="{x:.1}" y="{y:.1}" text-anchor="{anchor}">{words}</text>"#);
}

pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// At most `POINTS_MAX` finite points. Paths are sampled evenly; of a time line each stretch keeps
/// its lowest and its highest point, so that no peak is lost.
fn thinned(points: &[(f64, f64)], path: bool) -> Vec<(f64, f64)> {
    let finite: Vec<(f64, f64)> = points.iter().copied().filter(|p| p.0.is_finite() && p.1.is_finite()).collect();
    if finite.len() <= POINTS_MAX {
        return finite;
    }
    if path {
        let step = finite.len().div_ceil(POINTS_MAX);
        return finite.iter().step_by(step).chain(finite.last()).copied().collect();
    }
    let extremes = |stretch: &[(f64, f64)]| {
        let low = (0..stretch.len()).min_by(|&a, &b| stretch[a].1.total_cmp(&stretch[b].1)).unwrap_or(0);
        let high = (0..stretch.len()).max_by(|&a, &b| stretch[a].1.total_cmp(&stretch[b].1)).unwrap_or(0);
        [stretch[low.min(high)], stretch[low.max(high)]]
    };
    finite.chunks(finite.len().div_ceil(POINTS_MAX / 2)).flat_map(extremes).collect()
}

fn range(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    values.filter(|v| v.is_finite()).fold(None, |r, v| match r {
        None => Some((v, v)),
        Some((a, b)) => Some((a.min(v), b.max(v))),
    })
}

/// Some room below and above, as fractions; never empty.
fn widened(from: f64, to: f64, below: f64, above: f64) -> (f64, f64) {
    let span = to - from;
    if span > 1e-9 * to.abs().max(from.abs()).max(1e-6) {
        return (from - below * span, to + above * span);
    }
    let room = if to == 0.0 { 1.0 } else { 0.1 * to.abs() };
    (if below > 0.0 { from - room } else { from }, to + room)
}

fn centred(from: f64, to: f64, span: f64) -> (f64, f64) {
    let middle = 0.5 * (from + to);
    (middle - 0.5 * span, middle + 0.5 * span)
}

/// Round values within the scale, about `count` of them, and their step.
fn ticks(scale: Scale, count: usize) -> (Vec<f64>, f64) {
    let raw = (scale.to - scale.from) / count as f64;
    let decade = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * decade).find(|s| *s >= raw).unwrap_or(10.0 * decade);
    let first = (scale.from / step - 1e-9).ceil() as i64;
    let last = (scale.to / step + 1e-9).floor() as i64;
    ((first..=last).map(|i| i as f64 * step).collect(), step)
}

/// A tick label with as many decimals as the step needs; thousands as k.
fn number(v: f64, step: f64) -> String {
    if v == 0.0 {
        return "0".to_string();
    }
    if v.abs() >= 10_000.0 || step >= 1000.0 {
        let decimals = if step % 1000.0 == 0.0 { 0 } else { 1 };
        return format!("{:.decimals$}k", v / 1000.0);
    }
    let decimals = (-(step.log10() + 1e-9).floor()).max(0.0) as usize;
    format!("{v:.decimals$}").replace('-', "\u{2212}")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        let scale = |from, to| Scale { from, to, start: 0.0, end: 1.0 };
        assert_eq!(ticks(scale(0.0, 10.0), 5), (vec![0.0, 2.0, 4.0, 6.0, 8.0, 10.0], 2.0));
        assert_eq!(ticks(scale(17.3, 24.9), 5).0, [18.0, 20.0, 22.0, 24.0]);
        let (small, step) = ticks(scale(0.0, 0.013), 5);
        assert_eq!(small.iter().map(|v| number(*v, step)).collect::<Vec<_>>(), ["0", "0.005", "0.010"]);
        assert_eq!(number(40_000.0, 10_000.0), "40k");
        assert_eq!(number(-0.5, 0.5), "\u{2212}0.5");
    }

    #[test]
    fn thinning_keeps_peaks() {
        let mut points: Vec<(f64, f64)> = (0..50_000).map(|i| (i as f64, 1.0)).collect();
        points[31_234].1 = 99.0;
        let thin = thinned(&points, false);
        assert!(thin.len() <= POINTS_MAX && thin.contains(&(31_234.0, 99.0)));
    }

    #[test]
    fn empty_and_constant_series_are_drawn_or_left_out() {
        let chart = |points: Vec<(f64, f64)>| Chart {
            title: "a < b",
            series: vec![Series { name: "s", ink: 1, dots: true, points }],
            ..Chart::default()
        };
        assert_eq!(chart(vec![(0.0, f64::NAN)]).svg(), None);
        for points in [vec![(1.0, 3.0)], vec![(0.0, 0.0), (1.0, 0.0)], vec![(5.0, 1e-12), (5.0, 1e12)]] {
            let svg = chart(points).svg().unwrap();
            assert!(!svg.contains("NaN") && !svg.contains("inf") && svg.contains("a &lt; b"), "{svg}");
        }
    }

    #[test]
    fn equal_axes_have_one_metre_per_pixel_both_ways() {
        let chart = Chart { equal: true, ..Chart::default() };
        let (x, y) = chart.scales(&[vec![(0.0, 0.0), (4.0, 0.5)]]).unwrap();
        let per_px = |s: Scale| ((s.to - s.from) / (s.end - s.start)).abs();
        assert!((per_px(x) - per_px(y)).abs() < 1e-12);
    }

    #[test]
    fn histogram_counts_everything_and_the_last_bin_takes_the_rest() {
        let outline = histogram(&[0.5, 1.5, 1.6, 99.0, f64::NAN], 2.0, 2);
        assert_eq!(outline, [(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 3.0), (2.0, 3.0), (2.0, 0.0)]);
    }
}
