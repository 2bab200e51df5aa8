//! Derivatives, covariances and optima of the pose graph against finite differences, samples and dense matrices.
#![allow(clippy::unwrap_used)]
use super::*;
use crate::world::{stream, Noise};
use glam::DVec3;
use nalgebra::DMatrix;
use std::time::Instant;

fn pose(noise: &mut Noise, p: f64, yaw: f64) -> Pose4 {
    Pose4 { p: noise.vector() * p, yaw: noise.normal() * yaw }
}

fn random_covariance(noise: &mut Noise, scale: f64) -> Matrix4<f64> {
    let m = Matrix4::from_fn(|_, _| noise.normal());
    (m * m.transpose() + Matrix4::identity()) * scale
}

fn diagonal(p: f64, yaw: f64) -> Matrix4<f64> {
    Matrix4::from_diagonal(&Vector4::new(p * p, p * p, p * p, yaw * yaw))
}

fn moved(pose: &Pose4, k: usize, by: f64) -> Pose4 {
    let mut pose = *pose;
    if k < 3 {
        pose.p[k] += by;
    } else {
        pose.yaw += by;
    }
    pose
}

/// A walk around a square of so many rounds, with drift of odometry, and true loops to the round before.
fn rounds(rounds: usize, per_round: usize, noise: &mut Noise) -> (PoseGraph, Vec<Pose4>) {
    let n = rounds * per_round;
    let truth: Vec<Pose4> = (0..n)
        .map(|k| {
            let a = k as f64 / per_round as f64 * std::f64::consts::TAU;
            Pose4 { p: DVec3::new(10.0 * a.cos(), 10.0 * a.sin(), 0.3 * a.sin()), yaw: wrapped(a) }
        })
        .collect();
    let mut graph = PoseGraph::new(n, 4 * n, 16 * n);
    let mut at = truth[0];
    for k in 0..n {
        if k > 0 {
            let measured = truth[k - 1].between(&truth[k]).compose(&pose(noise, 0.02, 0.005));
            at = at.compose(&measured);
            graph.add(at).unwrap();
            let (from, to) = (k as u16 - 1, k as u16);
            graph.link(Edge { from, to, measured, covariance: diagonal(0.02, 0.005), is_loop: false }).unwrap();
        } else {
            graph.add(at).unwrap();
        }
        if k >= per_round && k % 3 == 0 {
            let from = (k - per_round) as u16;
            let measured = truth[from as usize].between(&truth[k]).compose(&pose(noise, 0.01, 0.003));
            graph
                .link(Edge { from, to: k as u16, measured, covariance: diagonal(0.01, 0.003), is_loop: true })
                .unwrap();
        }
    }
    (graph, truth)
}

fn error(graph: &PoseGraph, truth: &[Pose4]) -> f64 {
    (0..truth.len()).map(|k| (graph.pose(k as u16).p - truth[k].p).length()).fold(0.0, f64::max)
}

#[test]
fn jacobians_are_the_derivatives() {
    let mut noise = stream(1, 0);
    for _ in 0..20 {
        let (a, b) = (pose(&mut noise, 5.0, 2.0), pose(&mut noise, 5.0, 2.0));
        let measured = pose(&mut noise, 5.0, 2.0);
        let edge = Edge { from: 0, to: 1, measured, covariance: diagonal(1.0, 1.0), is_loop: false };
        let (_, j) = edge.residual(&a, &b);
        for k in 0..4 {
            let h = 1e-6;
            let by_a = (edge.residual(&moved(&a, k, h), &b).0 - edge.residual(&moved(&a, k, -h), &b).0) / (2.0 * h);
            let by_b = (edge.residual(&a, &moved(&b, k, h)).0 - edge.residual(&a, &moved(&b, k, -h)).0) / (2.0 * h);
            assert!((by_a - j[0].column(k)).amax() < 1e-7 && (by_b - j[1].column(k)).amax() < 1e-7);
        }
    }
}

#[test]
fn edges_in_a_row_and_backwards_have_the_covariance_of_samples() {
    let mut noise = stream(2, 0);
    let edge = |from: u16, noise: &mut Noise| Edge {
        from,
        to: from + 1,
        measured: pose(noise, 3.0, 1.0),
        covariance: random_covariance(noise, 1e-6),
        is_loop: false,
    };
    let (a, b) = (edge(0, &mut noise), edge(1, &mut noise));
    let (ab, back) = (a.then(&b), a.inverse());
    // Measurements with errors: in the frame where an edge begins.
    let disturbed = |e: &Edge, noise: &mut Noise| {
        let d = e.covariance.cholesky().unwrap().l() * Vector4::from_fn(|_, _| noise.normal());
        Pose4 { p: e.measured.p + DVec3::new(d[0], d[1], d[2]), yaw: e.measured.yaw + d[3] }
    };
    let difference = |x: &Pose4, y: &Pose4| {
        let d = x.p - y.p;
        Vector4::new(d.x, d.y, d.z, wrapped(x.yaw - y.yaw))
    };
    let (mut sum, mut sum_back) = (Matrix4::zeros(), Matrix4::zeros());
    let n = 20_000;
    for _ in 0..n {
        let (x, y) = (disturbed(&a, &mut noise), disturbed(&b, &mut noise));
        let d = difference(&x.compose(&y), &ab.measured);
        sum += d * d.transpose() / n as f64;
        let d = difference(&x.inverse(), &back.measured);
        sum_back += d * d.transpose() / n as f64;
    }
    assert!((sum - ab.covariance).amax() < 0.05 * ab.covariance.amax(), "{sum} {}", ab.covariance);
    assert!((sum_back - back.covariance).amax() < 0.05 * back.covariance.amax());
    assert_eq!((ab.from, ab.to, back.from, back.to), (0, 2, 1, 0));
}

/// The information of all edges at the poses of a graph, the first node held.
fn dense(graph: &PoseGraph, n: usize) -> DMatrix<f64> {
    let mut h = DMatrix::zeros(4 * n, 4 * n);
    h.view_mut((0, 0), (4, 4)).fill_diagonal(1e8);
    for (e, w) in graph.edges.iter().zip(&graph.weights) {
        let (a, b) = (e.from as usize, e.to as usize);
        let (_, j) = e.residual(&graph.poses[a], &graph.poses[b]);
        let info = e.covariance.try_inverse().unwrap() * *w;
        for (x, jx) in [(a, j[0]), (b, j[1])] {
            for (y, jy) in [(a, j[0]), (b, j[1])] {
                let mut view = h.view_mut((4 * x, 4 * y), (4, 4));
                view += jx.transpose() * info * jy;
            }
        }
    }
    h
}

#[test]
fn the_sparse_solution_is_an_optimum_and_its_covariances_are_those_of_the_dense_inverse() {
    let mut noise = stream(3, 0);
    let (mut graph, _) = rounds(3, 8, &mut noise);
    let n = 24;
    let outcome = graph.optimise();
    assert!(outcome.solved && outcome.loops_rejected == 0, "{outcome:?}");
    // No small step of any node makes it cheaper.
    let cost = |g: &PoseGraph| (0..g.edges.len()).map(|i| g.cost(i)).sum::<f64>();
    let least = cost(&graph);
    for node in 1..n {
        for k in 0..4 {
            for by in [-1e-3, 1e-3] {
                let pose = graph.poses[node];
                graph.poses[node] = moved(&pose, k, by);
                assert!(cost(&graph) > least - 1e-9, "{node} {k}: {} {least}", cost(&graph));
                graph.poses[node] = pose;
            }
        }
    }
    graph.factor().unwrap();
    let inverse = dense(&graph, n).try_inverse().unwrap();
    for (a, b) in [(0u16, 23u16), (5, 6), (20, 3), (11, 12)] {
        let [ja, jb] = edge::jacobians(&graph.pose(a), &graph.pose(b));
        let (x, y) = (4 * a as usize, 4 * b as usize);
        let block = |i: usize, j: usize| inverse.fixed_view::<4, 4>(i, j).into_owned();
        let want = ja * block(x, x) * ja.transpose()
            + ja * block(x, y) * jb.transpose()
            + jb * block(y, x) * ja.transpose()
            + jb * block(y, y) * jb.transpose();
        let got = graph.covariance_between(a, b).unwrap();
        assert!((got - want).amax() < 1e-6 * want.amax(), "{a} {b}: {got} {want}");
    }
}

#[test]
fn a_chain_has_the_covariance_of_its_edges_in_the_factor_and_behind_it() {
    let mut noise = stream(4, 0);
    let mut graph = PoseGraph::new(16, 32, 256);
    let mut whole: Option<Edge> = None;
    for k in 0..10u16 {
        let before = k.checked_sub(1).map(|b| graph.pose(b)).unwrap_or_default();
        let measured = pose(&mut noise, 1.0, 0.5);
        graph.add(before.compose(&measured)).unwrap();
        if k > 0 {
            let covariance = random_covariance(&mut noise, 1e-5);
            let edge = Edge { from: k - 1, to: k, measured, covariance, is_loop: false };
            graph.link(edge).unwrap();
            whole = Some(whole.map_or(edge, |w| w.then(&edge)));
        }
        if k == 6 {
            assert!(graph.optimise().solved);
        }
    }
    let (got, want) = (graph.covariance_between(0, 9).unwrap(), whole.unwrap().covariance);
    assert!((got - want).amax() < 1e-6 * want.amax(), "{got} {want}");
    let back = graph.covariance_between(9, 0).unwrap();
    assert!((back - whole.unwrap().inverse().covariance).amax() < 1e-6 * back.amax());
    assert!(graph.covariance_between(9, 8).is_some(), "both behind the factor");
}

#[test]
fn drift_goes_and_false_loops_are_rejected() {
    for seed in 0..6 {
        let mut noise = stream(10 + seed, 0);
        let (mut graph, truth) = rounds(4, 50, &mut noise);
        let drift = error(&graph, &truth);
        let outcome = graph.optimise();
        let good = error(&graph, &truth);
        assert!(outcome.solved && drift > 0.5 && good < 0.5 * drift, "{seed}: {drift} {good} {outcome:?}");
        // A quarter as many false ones, of which some agree with each other.
        let wrong = pose(&mut noise, 3.0, 0.0);
        for k in 0..12u16 {
            let (from, to) = (20 + 3 * k, 150 + 4 * k);
            let off = if k % 2 == 0 { wrong } else { pose(&mut noise, 5.0, 0.7) };
            let measured = truth[from as usize].between(&truth[to as usize]).compose(&off);
            graph.link(Edge { from, to, measured, covariance: diagonal(0.01, 0.003), is_loop: true }).unwrap();
        }
        let outcome = graph.optimise();
        let after = error(&graph, &truth);
        assert!(outcome.loops_rejected == 12 && after < good + 0.02, "{seed}: {good} {after} {outcome:?}");
        assert!(graph
            .loops()
            .all(|(e, w)| (w < REJECTED) == (e.from >= 20 && e.to >= 150 && (e.to - e.from) != 50)
                || (e.to - e.from) == 50));
    }
}

#[test]
fn a_dropped_node_leaves_the_optimum_of_the_others() {
    let mut noise = stream(7, 0);
    let (mut graph, _) = rounds(3, 20, &mut noise);
    let (mut less, _) = rounds(3, 20, &mut stream(7, 0));
    assert!(graph.optimise().solved);
    // Those without loops first: nothing is lost. Then one with loops.
    for node in [5u16, 22, 41, 43, 30] {
        less.drop_node(node);
    }
    assert_eq!((less.used[5], less.edges.iter().filter(|e| !e.is_loop).count()), (false, 54));
    assert!(less.optimise().solved);
    for k in (0..60u16).filter(|k| less.used[*k as usize]) {
        let apart = (less.pose(k).p - graph.pose(k).p).length();
        assert!(apart < 0.03, "{k}: {apart}");
    }
    // The room is used again.
    assert_eq!(less.add(Pose4::default()), Some(5));
}

#[test]
fn what_odometry_measures_again_moves_what_follows_and_keeps_what_loops_did() {
    let mut noise = stream(8, 0);
    let (mut graph, truth) = rounds(2, 12, &mut noise);
    assert!(graph.optimise().solved);
    let n = truth.len() as u16 - 1;
    let was: Vec<Pose4> = (0..=n).map(|k| graph.pose(k)).collect();
    let chain = |k: u16, graph: &PoseGraph| graph.edges.iter().position(|e| !e.is_loop && e.to == k).unwrap();
    let measured = |k: u16, graph: &PoseGraph| graph.edges[chain(k, graph)].measured;
    // The same again moves nothing.
    let same: Vec<(u16, Pose4)> = (n - 3..=n).map(|k| (k, measured(k, &graph))).collect();
    graph.measure_again(&same);
    assert!((0..=n).all(|k| (graph.pose(k).p - was[k as usize].p).length() < 1e-9));
    // One that is longer by a change takes all that follow along by it.
    let change = Pose4 { p: DVec3::new(0.1, 0.0, 0.0), yaw: 0.01 };
    let longer: Vec<(u16, Pose4)> =
        same.iter().map(|(k, m)| (*k, if *k == n - 2 { m.compose(&change) } else { *m })).collect();
    graph.measure_again(&longer);
    let moved = was[n as usize - 2].compose(&change);
    for k in n - 2..=n {
        let expected = moved.compose(&was[n as usize - 2].between(&was[k as usize]));
        assert!((graph.pose(k).p - expected.p).length() < 1e-9, "{k}");
        assert!(wrapped(graph.pose(k).yaw - expected.yaw).abs() < 1e-9, "{k}");
    }
    assert_eq!(measured(n - 2, &graph), longer[1].1);
    assert!((0..n - 2).all(|k| (graph.pose(k).p - was[k as usize].p).length() < 1e-9));
    // A node that no odometry leads to stays.
    graph.measure_again(&[(0, change)]);
    assert!((graph.pose(0).p - was[0].p).length() < 1e-12);
}

#[test]
fn the_node_to_drop_is_that_of_the_definition_after_links_drops_and_new_measurements() {
    let mut noise = stream(12, 0);
    let (mut graph, _) = rounds(3, 20, &mut noise);
    let defined = |graph: &PoseGraph, not: u16| {
        let edge = |n: u16, k: usize| graph.edges.get(graph.chain[n as usize][k] as usize).map(|e| e.measured);
        let apart = |n: u16| {
            let moved = edge(n, 0)?.compose(&edge(n, 1)?);
            (n != not).then_some((n, moved.p.length() + 2.0 * moved.yaw.abs()))
        };
        (0..60).filter_map(apart).min_by(|a, b| a.1.total_cmp(&b.1)).map(|(n, _)| n)
    };
    for round in 0..50u16 {
        let not = round % 60;
        let node = graph.closest_neighbours(|n| n != not);
        assert_eq!(node, defined(&graph, not), "round {round}");
        match (round % 3, node) {
            (0, Some(node)) => graph.measure_again(&[(node, pose(&mut noise, 1.0, 0.3))]),
            (_, Some(node)) => graph.drop_node(node),
            (_, None) => {}
        }
    }
    let used = graph.used.iter().filter(|used| **used).count();
    assert_eq!(used, 60 - 33, "two of three rounds drop one");
    // A place that was given up is free for a node without odometry.
    let node = graph.add(Pose4::default()).unwrap();
    assert_eq!(graph.apart[node as usize], f64::INFINITY);
}

#[test]
fn what_is_no_measurement_is_refused_and_what_is_full_says_so() {
    let mut graph = PoseGraph::new(3, 3, 9);
    assert_eq!(graph.add(Pose4 { p: DVec3::NAN, yaw: 0.0 }), None);
    let nodes: Vec<u16> = (0..3).map(|_| graph.add(Pose4::default()).unwrap()).collect();
    assert_eq!(graph.add(Pose4::default()), None);
    let edge = |from, to, p: f64, variance: f64, is_loop| Edge {
        from,
        to,
        measured: Pose4 { p: DVec3::splat(p), yaw: 0.0 },
        covariance: Matrix4::identity() * variance,
        is_loop,
    };
    for (p, variance) in [(f64::NAN, 1.0), (f64::INFINITY, 1.0), (1.0, 0.0), (1.0, -1.0), (1.0, f64::NAN), (1.0, 1e300)]
    {
        assert_eq!(graph.link(edge(0, 1, p, variance, true)), None, "{p} {variance}");
    }
    assert_eq!(graph.link(edge(0, 0, 1.0, 1.0, true)), None);
    assert_eq!(graph.link(edge(0, 9, 1.0, 1.0, true)), None);
    assert_eq!(graph.covariance_between(nodes[0], nodes[1]), None, "not connected");
    assert!(graph.link(edge(0, 1, 1.0, 1.0, false)).is_some());
    assert_eq!(graph.link(edge(0, 2, 1.0, 1.0, false)), None, "odometry leads to one node");
    assert!(graph.link(edge(1, 2, 1.0, 1.0, false)).is_some() && graph.link(edge(0, 2, 2.0, 1.0, true)).is_some());
    assert_eq!(graph.link(edge(0, 2, 1.0, 1.0, true)), None, "full");
    assert!(graph.optimise().solved);
    let mut looped = PoseGraph::new(3, 3, 9);
    (0..3).for_each(|_| assert!(looped.add(Pose4::default()).is_some()));
    assert!(looped.link(edge(0, 2, 2.0, 1.0, true)).is_some() && looped.link(edge(0, 1, 1.0, 1.0, true)).is_none());
    let odometry = [edge(0, 1, 1.0, 1.0, false), edge(1, 2, 1.0, 1.0, false)];
    odometry.into_iter().for_each(|edge| assert!(looped.link(edge).is_some(), "room that loops do not take"));
    let mut small = PoseGraph::new(4, 9, 1);
    (0..4).for_each(|_| assert!(small.add(Pose4::default()).is_some()));
    let all = (0..4).flat_map(|a| (a + 1..4).map(move |b| (a, b)));
    all.for_each(|(a, b)| assert!(small.link(edge(a, b, 1.0, 1.0, true)).is_some()));
    assert!(!small.optimise().solved, "the factor does not fit");
    assert_eq!(small.pose(3), Pose4::default());
}

#[test]
fn far_from_the_origin_stiff_and_loose_edges_and_islands_are_solved() {
    let mut graph = PoseGraph::new(40, 80, 800);
    for island in 0..2 {
        let origin = Pose4 { p: DVec3::new(1e4, -1e4, 50.0) * island as f64, yaw: 3.1 };
        for k in 0..20u16 {
            let step = Pose4 { p: DVec3::X, yaw: 0.3 };
            let before = if k == 0 { origin } else { graph.pose(20 * island + k - 1).compose(&step) };
            graph.add(before).unwrap();
            if k > 0 {
                let to = 20 * island + k;
                let covariance = if k % 2 == 0 { diagonal(1e-4, 1e-4) } else { diagonal(1e2, 1.0) };
                graph.link(Edge { from: to - 1, to, measured: step, covariance, is_loop: false }).unwrap();
            }
        }
        let (from, to) = (20 * island, 20 * island + 19);
        let mut measured = graph.pose(from).between(&graph.pose(to));
        measured.p += DVec3::new(0.5, 0.0, 0.1);
        graph.link(Edge { from, to, measured, covariance: diagonal(0.01, 0.01), is_loop: true }).unwrap();
        let outcome = graph.optimise();
        let left = graph.pose(from).between(&graph.pose(to));
        assert!(outcome.solved && (left.p - measured.p).length() < 1e-3, "{outcome:?} {left:?} {measured:?}");
    }
    assert_eq!(graph.covariance_between(3, 25), None, "islands");
}

#[test]
fn a_loop_that_agrees_moves_a_settled_graph_as_the_whole_search_does() {
    let with_late_loop = |settled: bool| {
        let mut noise = stream(3, 1);
        let (mut graph, truth) = rounds(3, 40, &mut noise);
        assert!(graph.optimise().solved);
        let measured = truth[1].between(&truth[119]).compose(&pose(&mut noise, 0.01, 0.003));
        graph.link(Edge { from: 1, to: 119, measured, covariance: diagonal(0.01, 0.003), is_loop: true }).unwrap();
        graph.settled = if settled { graph.settled } else { 0 };
        (graph.optimise(), graph)
    };
    let ((quick, a), (whole, b)) = (with_late_loop(true), with_late_loop(false));
    assert!(quick.solved && quick.iterations <= whole.iterations, "{quick:?} {whole:?}");
    let apart = |n: u16| (a.pose(n).p - b.pose(n).p).length();
    let most = (0..120).map(apart).fold(0.0, f64::max);
    assert!(most < 1e-3, "{most}");
    // One that contradicts the others is searched for whole.
    let (_, mut c) = with_late_loop(true);
    let off = Pose4 { p: DVec3::new(3.0, 0.0, 0.0), yaw: 0.0 };
    let edge = |measured| Edge { from: 2, to: 118, measured, covariance: diagonal(0.01, 0.003), is_loop: true };
    c.link(edge(c.pose(2).between(&c.pose(118)).compose(&off))).unwrap();
    assert!(c.optimise().loops_rejected == 1);
}

#[test]
#[ignore = "prints times at capacity: cargo test --release --lib time_at_capacity -- --ignored --nocapture"]
fn time_at_capacity() {
    let mut noise = stream(9, 0);
    let (mut graph, truth) = rounds(8, 256, &mut noise);
    for _ in 0..5 {
        let begun = Instant::now();
        let outcome = graph.optimise();
        let optimised = begun.elapsed();
        let begun = Instant::now();
        let _ = graph.covariance_between(3, 2000);
        println!(
            "{optimised:?} {:?} {outcome:?} {} loops {} bytes, error {}",
            begun.elapsed(),
            graph.loops().count(),
            graph.bytes(),
            error(&graph, &truth)
        );
    }
}
