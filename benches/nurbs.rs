//! NURBS kernel: evaluations and cold inversions per second and thread, and misses: `cargo bench --bench nurbs`.
//!
//! A bicubic surface of 20 x 20 control points, the form that Open CASCADE 7.8 was measured on: 4.5 M/s first derivatives at
//! random places, 0.058 M/s cold projections. A miss is a foot farther away than one that brute force finds: the best of Newton's
//! method from 200 x 200 samples that are no worse than their neighbours.

#![allow(clippy::print_stdout, reason = "its table is what it is for")]

use std::hint::black_box;
use std::time::Instant;

use acies::geometry::NurbsSurface;
use acies::geometry::newton::nearest_on_surface;
use acies::geometry::nurbs_surface::NurbsShape;
use glam::DVec3;

/// Numbers from 0 to 1, the same every time (splitmix64).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

const POLES: usize = 20;

/// Hills of 8 mm and 45 mm length on 190 mm, with rough control points and, on request, weights of 0.5 to 1.5.
fn surface(rational: bool) -> NurbsSurface {
    let mut random = Random(7);
    let mut points = Vec::new();
    let mut weights = Vec::new();
    for i in 0..POLES {
        for j in 0..POLES {
            let (x, y) = (10.0 * i as f64, 10.0 * j as f64);
            let z = 8.0 * (0.14 * x).sin() * (0.11 * y).cos() + 2.0 * random.next();
            points.push(DVec3::new(x + random.next(), y + random.next(), z));
            weights.push(0.5 + random.next());
        }
    }
    let inner = (1..=POLES - 4).map(|k| k as f64);
    let knots: Vec<f64> = std::iter::repeat_n(0.0, 4)
        .chain(inner)
        .chain(std::iter::repeat_n((POLES - 3) as f64, 4))
        .collect();
    let shape = NurbsShape {
        degrees: [3, 3],
        counts: [POLES, POLES],
        knots: [knots.clone(), knots],
    };
    NurbsSurface::new(shape, &points, rational.then_some(&weights[..])).expect("a surface")
}

/// Seconds that this thread has computed, where the system tells: on a shared machine the clock counts others' work too.
fn thread_seconds() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    Some(text.split(' ').next()?.parse::<f64>().ok()? * 1e-9)
}

/// Best of five runs, in millions a second of this thread's own time; by the clock where several threads work.
fn rate(count: usize, alone: bool, mut run: impl FnMut()) -> f64 {
    let mut best = f64::INFINITY;
    for _ in 0..5 {
        let (start, own) = (Instant::now(), thread_seconds().filter(|_| alone));
        run();
        let by_clock = start.elapsed().as_secs_f64();
        let own = own.and_then(|o| Some(thread_seconds()? - o));
        best = best.min(own.unwrap_or(by_clock));
    }
    count as f64 / best / 1e6
}

fn main() {
    println!(
        "| surface | D1, M/s | D2, M/s | cold near, M/s | cold far, M/s | in order, 2 threads, M/s | misses near | misses far |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for rational in [false, true] {
        row(
            &surface(rational),
            if rational { "rational" } else { "polynomial" },
        );
    }
}

fn row(s: &NurbsSurface, name: &str) {
    let mut random = Random(1);
    let end = (POLES - 3) as f64;
    let places: Vec<(f64, f64)> = (0..1_000_000)
        .map(|_| (end * random.next(), end * random.next()))
        .collect();
    let d1 = rate(places.len(), true, || {
        let mut sum = DVec3::ZERO;
        for (u, v) in &places {
            let [p, du, dv] = s.first_derivatives(*u, *v);
            sum += p + du + dv;
        }
        black_box(sum);
    });
    let d2 = rate(places.len(), true, || {
        let mut sum = DVec3::ZERO;
        for (u, v) in &places {
            let d = s.derivatives(*u, *v);
            sum += d.point + d.du + d.dv + d.duu + d.duv + d.dvv;
        }
        black_box(sum);
    });
    // Within 5 mm of the surface, as points of a scan are before alignment; and anywhere in a box around it.
    let near: Vec<DVec3> = places[..10_000]
        .iter()
        .map(|(u, v)| {
            let by = |r: &mut Random| 10.0 * r.next() - 5.0;
            s.point(*u, *v)
                + DVec3::new(by(&mut random), by(&mut random), by(&mut random)) / 3f64.sqrt()
        })
        .collect();
    let far: Vec<DVec3> = (0..10_000)
        .map(|_| {
            DVec3::new(
                290.0 * random.next() - 50.0,
                290.0 * random.next() - 50.0,
                120.0 * random.next() - 60.0,
            )
        })
        .collect();
    let cold = |points: &[DVec3]| {
        rate(points.len(), true, || {
            let sum: f64 = points.iter().map(|p| s.nearest(*p, None).1).sum();
            black_box(sum);
        })
    };
    let (cold_near, cold_far) = (cold(&near), cold(&far));
    let ordered: Vec<DVec3> = (0..100_000)
        .map(|i| {
            let (row, column) = (i / 1000, i % 1000);
            let (u, v) = (
                end * f64::from(row) / 100.0,
                end * f64::from(column) / 1000.0,
            );
            s.point(u, v) + DVec3::Z * (random.next() - 0.5)
        })
        .collect();
    let both = rate(ordered.len(), false, || {
        black_box(s.nearest_of(&ordered));
    });
    println!(
        "| {name} | {d1:.1} | {d2:.1} | {cold_near:.3} | {cold_far:.3} | {both:.3} | {} | {} |",
        misses(s, &near),
        misses(s, &far)
    );
}

/// Points of which brute force finds a nearer foot.
fn misses(s: &NurbsSurface, points: &[DVec3]) -> usize {
    const N: usize = 200;
    let end = (POLES - 3) as f64;
    let at = |i: usize| end * i as f64 / N as f64;
    let samples: Vec<DVec3> = (0..=N)
        .flat_map(|i| (0..=N).map(move |j| (i, j)))
        .map(|(i, j)| s.point(at(i), at(j)))
        .collect();
    let stride = N + 1;
    let missed = |p: &DVec3| {
        let (_, found) = s.nearest(*p, None);
        let d2: Vec<f64> = samples.iter().map(|q| q.distance_squared(*p)).collect();
        let mut best = f64::INFINITY;
        for i in 0..=N {
            for j in 0..=N {
                let here = d2[i * stride + j];
                let nearer = |a: usize, b: usize| d2[a * stride + b] < here;
                let beaten = (i > 0 && nearer(i - 1, j))
                    || (i < N && nearer(i + 1, j))
                    || (j > 0 && nearer(i, j - 1))
                    || (j < N && nearer(i, j + 1));
                if !beaten && here.sqrt() < found + 1.0 {
                    let start = (at(i), at(j));
                    let ranges = s.ranges();
                    let (_, d2) = nearest_on_surface(|u, v| s.derivatives(u, v), *p, start, ranges);
                    best = best.min(d2);
                }
            }
        }
        found > best.sqrt() + 1e-9
    };
    use rayon::prelude::*;
    points.par_iter().filter(|p| missed(p)).count()
}
