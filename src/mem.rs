//! Fixed memory: fixed-capacity lists, the byte table, and the seal.
//!
//! The byte table is made by construction: a part is built once, and what the allocator gave it is its row, so no size is
//! stated twice. After construction every thread of ours calls `seal_thread`; from then on a heap allocation on it is
//! counted (`heap_after_seal`), and tests ask that none was. OpenCV and the Vulkan driver allocate behind us, inside
//! `unsealed` sections named for them. Both need `CountingAllocator` as the program's global allocator.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicU64, Ordering};

pub use stipple_drivers::List;

/// The bytes of a text, in whole characters, as many as fit.
pub fn cut<const N: usize>(text: &str) -> List<u8, N> {
    let end = (0..=N.min(text.len())).rev().find(|i| text.is_char_boundary(*i)).unwrap_or(0);
    let mut list = List::default();
    for byte in &text.as_bytes()[..end] {
        let _ = list.push(*byte);
    }
    list
}

/// A list of fixed size for a run without an end: holds every item while they fit, then every second, every fourth and so on.
#[derive(Clone, Debug)]
pub struct Thinned<T> {
    items: Vec<T>,
    stride: u64,
    /// Items pushed.
    pub seen: u64,
}

impl<T: Clone + Default> Thinned<T> {
    /// Room for so many, whose every page is there from the start: none is asked for in flight.
    pub fn with_capacity(capacity: usize) -> Thinned<T> {
        let mut items = vec![T::default(); capacity.max(2)];
        items.iter_mut().for_each(|item| *item = std::hint::black_box(T::default()));
        items.clear();
        Thinned { items, stride: 1, seen: 0 }
    }
}

impl<T> Thinned<T> {
    /// Whether it holds everything that was pushed.
    pub fn is_whole(&self) -> bool {
        self.stride == 1
    }

    pub fn push(&mut self, item: T) {
        if self.seen % self.stride == 0 && self.items.len() == self.items.capacity() {
            let mut index = 0;
            self.items.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.stride *= 2;
        }
        if self.seen % self.stride == 0 {
            self.items.push(item);
        }
        self.seen += 1;
    }
}

impl<T> std::ops::Deref for Thinned<T> {
    type Target = [T];
    fn deref(&self) -> &[T] {
        &self.items
    }
}

/// Bytes a part takes, by name; `stipple check` prints the sum of all of them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Footprint {
    pub rows: Vec<Row>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Row {
    pub name: &'static str,
    pub bytes: u64,
    pub gpu: bool,
}

impl Footprint {
    /// Builds a part, and adds the bytes it takes: its own size and the heap it holds when it is built. What is built is
    /// the caller's, to drop or to build on.
    pub fn build<T>(&mut self, name: &'static str, build: impl FnOnce() -> T) -> T {
        let before = HEAP.get();
        let part = build();
        self.host(name, size_of::<T>() + (HEAP.get() - before).max(0) as usize);
        part
    }

    pub fn host(&mut self, name: &'static str, bytes: usize) {
        self.rows.push(Row { name, bytes: bytes as u64, gpu: false });
    }

    pub fn gpu(&mut self, name: &'static str, bytes: usize) {
        self.rows.push(Row { name, bytes: bytes as u64, gpu: true });
    }

    pub fn extend(&mut self, other: Footprint) {
        self.rows.extend(other.rows);
    }

    pub fn total(&self) -> u64 {
        self.rows.iter().map(|r| r.bytes).sum()
    }

    pub fn gpu_total(&self) -> u64 {
        self.rows.iter().filter(|r| r.gpu).map(|r| r.bytes).sum()
    }
}

thread_local! {
    static SEALED: Cell<bool> = const { Cell::new(false) };
    /// Bytes this thread took from the heap less those it gave back.
    static HEAP: Cell<i64> = const { Cell::new(0) };
}

static HEAP_AFTER_SEAL: AtomicU64 = AtomicU64::new(0);

/// From here on heap allocations of this thread are counted.
pub fn seal_thread() {
    SEALED.set(true);
}

/// Runs code that is known to allocate (a driver, a library, a report) with the seal lifted.
pub fn unsealed<R>(f: impl FnOnce() -> R) -> R {
    let was = SEALED.replace(false);
    let r = f();
    SEALED.set(was);
    r
}

/// Allocations made by sealed threads since the program started.
pub fn heap_after_seal() -> u64 {
    HEAP_AFTER_SEAL.load(Ordering::Relaxed)
}

/// The system allocator, counting what sealed threads ask of it.
pub struct CountingAllocator;

/// Counts an allocation, and `bytes` more that the thread holds.
fn count(bytes: i64) {
    // try_with: a thread being torn down has no counters any more, and is not ours to judge.
    if SEALED.try_with(Cell::get).unwrap_or(false) {
        HEAP_AFTER_SEAL.fetch_add(1, Ordering::Relaxed);
    }
    hold(bytes);
}

fn hold(bytes: i64) {
    let _ = HEAP.try_with(|heap| heap.set(heap.get() + bytes));
}

// SAFETY: every call is passed to the system allocator unchanged; counting touches no heap.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size() as i64);
        // SAFETY: the caller's contract is the system allocator's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        hold(-(layout.size() as i64));
        // SAFETY: as above; `ptr` came from `System`.
        unsafe { System.dealloc(ptr, layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count(layout.size() as i64);
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, ptr: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        count(new_size as i64 - layout.size() as i64);
        // SAFETY: as above.
        unsafe { System.realloc(ptr, layout, new_size) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_list_is_thinned_evenly_and_never_grows() {
        for capacity in [2, 5, 8] {
            let mut list = Thinned::with_capacity(capacity);
            for i in 0..1000u64 {
                list.push(i);
                let step = list.get(1).map_or(1, |second| second - list[0]);
                assert!(list.is_whole() == (i < capacity as u64) && list.seen == i + 1);
                assert!(list[0] == 0 && list.windows(2).all(|w| w[1] - w[0] == step), "{list:?}");
                assert!(list.len() <= capacity && i - list[list.len() - 1] < step, "{list:?} after {i}");
                assert_eq!(list.items.capacity(), capacity);
            }
        }
    }
}
