// Rows of a curve to draw where it has more than the plot has pixels.

/** All rows, or those of the first, least, greatest and last value of each of at most `bins` bins, so that short peaks are drawn. */
export function extremes(rows, bins, value) {
  const size = Math.ceil(rows / bins), kept = [];
  for (let start = 0; start < rows; start += size) {
    const stop = Math.min(start + size, rows);
    if (size <= 4) { for (let row = start; row < stop; row++) kept.push(row); continue; }
    let low = -1, high = -1, least = Infinity, greatest = -Infinity;
    for (let row = start; row < stop; row++) {
      const y = value(row);
      if (!Number.isFinite(y)) continue;
      if (y < least) [low, least] = [row, y];
      if (y > greatest) [high, greatest] = [row, y];
    }
    const found = [start, low, high, stop - 1].filter((row) => row >= 0);
    kept.push(...new Set(found.sort((a, b) => a - b)));
  }
  return kept;
}
