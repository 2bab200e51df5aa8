//! Twins of the stereo kernels: integers up to the matches, f64 in the filter.

/// As the kernels take it: 8 bit, rows without padding.
#[derive(Clone)]
pub struct Grey {
    pub width: usize,
    pub height: usize,
    pub pixels: Vec<u8>,
}

impl Grey {
    fn at(&self, x: i64, y: i64) -> u8 {
        let (x, y) = (x.clamp(0, self.width as i64 - 1), y.clamp(0, self.height as i64 - 1));
        self.pixels[y as usize * self.width + x as usize]
    }
}

#[derive(Clone, Copy)]
pub struct Penalties {
    pub outside: u32,
    pub p1: u32,
    pub p2: u32,
    pub p2_slope: u32,
    pub p2_min: u32,
}

/// Twin of census.comp.
pub fn census(image: &Grey) -> Vec<u32> {
    let mut strings = Vec::new();
    for y in 0..image.height as i64 {
        for x in 0..image.width as i64 {
            let around = (-3..=3)
                .flat_map(|v| (-3..=3).map(move |u: i64| (u, v)))
                .filter(|(u, v): &(i64, i64)| [u.abs(), v.abs()] == [2, 2] || (u * v == 0 && u + v != 0));
            let two = |(u, v)| match i16::from(image.at(x + u, y + v)) - i16::from(image.at(x, y)) {
                ..0 => 1,
                0..=1 => 0,
                2.. => 2u32,
            };
            strings.push(around.enumerate().map(|(n, at)| two(at) << (2 * n)).sum());
        }
    }
    strings
}

/// Twin of aggregate.comp: L by pixel and disparity along one direction.
pub fn aggregate(left: &Grey, strings: [&[u32]; 2], disparities: usize, step: [i32; 2], p: Penalties) -> Vec<u32> {
    let (w, h) = (left.width as i64, left.height as i64);
    let mut l = vec![0; (w * h) as usize * disparities];
    let forward = |n: i64, s: i32| -> Vec<i64> {
        if s >= 0 {
            (0..n).collect()
        } else {
            (0..n).rev().collect()
        }
    };
    for &y in &forward(h, step[1]) {
        for &x in &forward(w, step[0]) {
            let (bx, by) = (x - i64::from(step[0]), y - i64::from(step[1]));
            let inside = (0..w).contains(&bx) && (0..h).contains(&by);
            let here = (y * w + x) as usize;
            let before: Option<Vec<u32>> =
                inside.then(|| l[(by * w + bx) as usize * disparities..][..disparities].to_vec());
            let change = u32::from(left.at(x, y).abs_diff(left.at(bx, by)));
            let jump = p.p2.saturating_sub(p.p2_slope * change).max(p.p2_min);
            for d in 0..disparities {
                let cost = match here.checked_sub(d) {
                    Some(there) if d as i64 <= x => (strings[0][here] ^ strings[1][there]).count_ones(),
                    _ => p.outside,
                };
                l[here * disparities + d] = cost
                    + before.as_ref().map_or(0, |b| {
                        let least = *b.iter().min().unwrap();
                        let beside = [d.checked_sub(1), Some(d + 1)].into_iter().flatten().filter_map(|e| b.get(e));
                        let smooth = beside.map(|v| v + p.p1).chain([b[d], least + jump]).min().unwrap();
                        smooth - least
                    });
            }
        }
    }
    l
}

/// Twin of match_right.comp.
pub fn match_right(sums: &[u32], width: usize, disparities: usize) -> Vec<u32> {
    let best = |i: usize| {
        let reach = disparities.min(width - i % width);
        (0..reach).min_by_key(|d| sums[(i + d) * disparities + d]).unwrap() as u32
    };
    (0..sums.len() / disparities).map(best).collect()
}

/// Twin of match_left.comp.
pub fn match_left(
    sums: &[u32],
    right: &[u32],
    width: usize,
    disparities: usize,
    unique: u32,
    disagree: u32,
) -> Vec<f64> {
    let one = |i: usize| {
        let s = &sums[i * disparities..][..disparities];
        let best = (0..disparities).min_by_key(|d| s[*d]).unwrap();
        let rival = (0..disparities).filter(|d| d.abs_diff(best) > 1).map(|d| s[d]).min().unwrap();
        if best > i % width || 100 * s[best] > unique * rival || right[i - best].abs_diff(best as u32) > disagree {
            return -1.0;
        }
        if best == 0 || best + 1 == disparities {
            return best as f64;
        }
        let (before, after) = (f64::from(s[best - 1]), f64::from(s[best + 1]));
        let slope = before.max(after) - f64::from(s[best]);
        best as f64 + if slope > 0.0 { 0.5 * (before - after) / slope } else { 0.0 }
    };
    (0..sums.len() / disparities).map(one).collect()
}

/// Twin of speckle_join.comp: each known pixel's region is named by its first pixel; others by themselves.
pub fn speckle_join(disparity: &[f32], width: usize, close: f32) -> Vec<u32> {
    let mut labels: Vec<u32> = (0..disparity.len() as u32).collect();
    let mut seen = vec![false; disparity.len()];
    for first in 0..disparity.len() {
        let mut open = if seen[first] || disparity[first] < 0.0 { vec![] } else { vec![first] };
        seen[first] = true;
        while let Some(i) = open.pop() {
            labels[i] = first as u32;
            let x = i % width;
            let beside =
                [(x > 0, i.wrapping_sub(1)), (x + 1 < width, i + 1), (true, i.wrapping_sub(width)), (true, i + width)];
            for (_, j) in beside.into_iter().filter(|(inside, j)| *inside && *j < disparity.len()) {
                if !seen[j] && disparity[j] >= 0.0 && (disparity[j] - disparity[i]).abs() <= close {
                    seen[j] = true;
                    open.push(j);
                }
            }
        }
    }
    labels
}

/// Twin of speckle_count.comp.
pub fn speckle_count(disparity: &[f32], labels: &[u32]) -> Vec<u32> {
    let mut areas = vec![0; labels.len()];
    labels.iter().zip(disparity).filter(|(_, d)| **d >= 0.0).for_each(|(l, _)| areas[*l as usize] += 1);
    areas
}

/// Twin of speckle_drop.comp.
pub fn speckle_drop(disparity: &mut [f32], labels: &[u32], areas: &[u32], area_min: u32) {
    for (d, l) in disparity.iter_mut().zip(labels) {
        if areas[*l as usize] < area_min {
            *d = -1.0;
        }
    }
}

/// Twin of verify.comp: whether a disparity stands.
pub fn verify(
    strings: [&[u32]; 2],
    size: [usize; 2],
    disparities: usize,
    at: usize,
    found: f64,
    limits: [u32; 4],
) -> bool {
    let (w, h) = (size[0] as i64, size[1] as i64);
    let (x, y) = (at as i64 % w, at as i64 / w);
    let cost = |shift: i64, side: usize| -> u32 {
        let inside = |u: i64| u.clamp((-shift).max(0), (w - 1).min(w - 1 - shift));
        let pixels = (-1..=1).flat_map(|v| (-1..=1).map(move |u| (x + u, (y + v).clamp(0, h - 1))));
        let at = |(u, v): (i64, i64)| ((v * w + inside(u)) as usize, (v * w + inside(u) + shift) as usize);
        pixels.map(at).map(|(a, b)| (strings[0][a] ^ strings[side][b]).count_ones()).sum()
    };
    let farthest = (disparities as i64 - 1).min(x);
    let best = ((found + 0.5) as i64).min(farthest);
    let own = (best - 1..=best + 1).map(|d| cost(-d.clamp(0, farthest), 1)).min().unwrap();
    let [chance, fit, alike, wall] = limits;
    let repeats = |side: i64| {
        let room = if side < 0 { x } else { w - 1 - x }.min(disparities as i64 - 1);
        let costs: Vec<u32> = (2..=room).map(|k| cost(side * k, 0)).collect();
        let rival = |k: &usize| costs[*k] <= own + alike && costs[..*k].iter().any(|c| *c >= own + wall);
        (0..costs.len()).any(|k| rival(&k))
    };
    own <= chance && (own > fit || !(repeats(-1) || repeats(1)))
}

/// Twin of rectify.comp, for rows of `stride` bytes: a pixel by its tap.
pub fn rectify(raw: &[u8], stride: usize, [at, weights]: [u32; 2]) -> u8 {
    if at == u32::MAX {
        return 0;
    }
    let (at, wx, wy) = (at as usize, f64::from(weights & 0xffff) / 128.0, f64::from(weights >> 16) / 128.0);
    let row = |i: usize| f64::from(raw[i]) * (1.0 - wx) + f64::from(raw[i + 1]) * wx;
    (row(at) * (1.0 - wy) + row(at + stride) * wy + 0.5).floor() as u8
}

/// Twin of fill_rows.comp: weighted disparities and weights. Of a pixel filled in between disparities that are alike, of
/// another, alike, and the reach.
pub fn fill_rows(disparity: &[f32], width: usize, [fill, hidden, alike, reach]: [f64; 4]) -> Vec<[f64; 2]> {
    let mut data = Vec::new();
    for row in disparity.chunks(width) {
        let known: Vec<usize> = (0..width).filter(|x| row[*x] >= 0.0).collect();
        for x in 0..width {
            let left = known.iter().rev().find(|k| **k <= x);
            let right = known.iter().find(|k| **k >= x);
            let from = left.into_iter().chain(right).min_by(|a, b| row[**a].total_cmp(&row[**b]));
            let between = left.zip(right).is_some_and(|(a, b)| f64::from((row[*a] - row[*b]).abs()) <= alike);
            data.push(from.map_or([0.0; 2], |k| {
                let far = (2.0 - k.abs_diff(x) as f64 / reach).clamp(0.01, 1.0);
                let weight = if *k == x { 1.0 } else { far * if between { fill } else { hidden } };
                [weight * f64::from(row[*k]), weight]
            }));
        }
    }
    data
}

/// Twin of median.comp.
pub fn median(data: &[[f64; 2]], width: usize) -> Vec<[f64; 2]> {
    let one = |i: usize| {
        let (x, y) = (i % width, i / width);
        let near = |j: &usize| (j % width).abs_diff(x) <= 1 && (j / width).abs_diff(y) <= 1 && data[*j][1] > 0.0;
        let mut around: Vec<f64> = (0..data.len()).filter(near).map(|j| data[j][0] / data[j][1]).collect();
        around.sort_by(f64::total_cmp);
        let weight = data[i][1];
        [if weight > 0.0 { weight * around[around.len() / 2] } else { 0.0 }, weight]
    };
    (0..data.len()).map(one).collect()
}

/// Twin of smooth_lines.comp: one line, by elimination of the dense system.
pub fn smooth_line(levels: &[u8], data: &[[f64; 2]], lambda: f64, sigma: f64) -> Vec<[f64; 2]> {
    let n = levels.len();
    let mut m = vec![vec![0.0; n]; n];
    for i in 0..n {
        m[i][i] += 1.0;
    }
    for i in 1..n {
        let link = lambda * (-f64::from(levels[i].abs_diff(levels[i - 1])) / sigma).exp();
        m[i][i] += link;
        m[i - 1][i - 1] += link;
        m[i][i - 1] -= link;
        m[i - 1][i] -= link;
    }
    let mut u = data.to_vec();
    for i in 0..n {
        for j in i + 1..n {
            let f = m[j][i] / m[i][i];
            if f != 0.0 {
                (i..n).for_each(|k| m[j][k] -= f * m[i][k]);
                (0..2).for_each(|c| u[j][c] -= f * u[i][c]);
            }
        }
    }
    for i in (0..n).rev() {
        for c in 0..2 {
            let known: f64 = (i + 1..n).map(|k| m[i][k] * u[k][c]).sum();
            u[i][c] = (u[i][c] - known) / m[i][i];
        }
    }
    u
}

/// Twin of smooth_lines.comp over an image.
pub fn smooth_lines(image: &Grey, data: &mut [[f64; 2]], columns: bool, lambda: f64, sigma: f64) {
    let (w, h) = (image.width, image.height);
    let (lines, n) = if columns { (w, h) } else { (h, w) };
    for line in 0..lines {
        let at: Vec<usize> = (0..n).map(|k| if columns { k * w + line } else { line * w + k }).collect();
        let levels: Vec<u8> = at.iter().map(|i| image.pixels[*i]).collect();
        let u = smooth_line(&levels, &at.iter().map(|i| data[*i]).collect::<Vec<_>>(), lambda, sigma);
        at.iter().zip(u).for_each(|(i, u)| data[*i] = u);
    }
}

/// Constants of settle.comp.
pub struct Variance {
    pub weight_min: f64,
    pub fill: f64,
    pub least: f64,
    pub bent: f64,
    pub bent_far: f64,
    pub faint: f64,
    pub missing: f64,
}

/// Twin of settle.comp: disparity and its deviation.
pub fn settle(image: &Grey, data: &[[f64; 2]], at: usize, c: &Variance) -> [f64; 2] {
    let (w, h) = (image.width as i64, image.height as i64);
    let (x, y) = (at as i64 % w, at as i64 / w);
    let [sum, weight] = data[at];
    if weight < c.weight_min {
        return [-1.0, 0.0];
    }
    let found = sum / weight;
    let around: Vec<(i64, i64)> = (-2..=2).flat_map(|v| (-2..=2).map(move |u| (u, v))).collect();
    let inside = |(u, v): (i64, i64)| ((x + u).clamp(0, w - 1), (y + v).clamp(0, h - 1));
    let of = |at: (i64, i64)| data[(at.1 * w + at.0) as usize];
    let slope = |at: (i64, i64)| 0.5 * (f64::from(image.at(at.0 + 1, at.1)) - f64::from(image.at(at.0 - 1, at.1)));
    let slopes = around.iter().map(|p| slope(inside(*p)).powi(2)).sum::<f64>() / 25.0;
    let weights = around.iter().map(|p| of(inside(*p))[1].min(1.0)).sum::<f64>() / 25.0;
    let known = around.iter().filter(|p| of(inside(**p))[1] >= c.weight_min);
    let places: Vec<[f64; 3]> =
        known.map(|p| [p.0 as f64, p.1 as f64, of(inside(*p))[0] / of(inside(*p))[1] - found]).collect();
    let mean = |f: &dyn Fn(&[f64; 3]) -> f64| places.iter().map(f).sum::<f64>() / places.len() as f64;
    let middle = [0, 1, 2].map(|k| mean(&|p| p[k]));
    let covariance = |a: usize, b: usize| mean(&|p| (p[a] - middle[a]) * (p[b] - middle[b]));
    let explained = |a: usize| covariance(a, 2).powi(2) / covariance(a, a).max(1e-3);
    let bent = (covariance(2, 2) - explained(0) - explained(1)).clamp(0.0, 25.0);
    let steps = (c.bent + c.bent_far / found.max(1.0)) * bent;
    let missing = c.missing * (1.0 - weights).max(0.0) * (c.fill / weight).max(1.0);
    [found, (c.least + steps + c.faint / (1.0 + slopes) + missing).sqrt()]
}
