// Otsu's threshold: where a histogram parts into two classes with the least variance in each.

/**
 * The bin whose end parts them; between classes without values the middle of the gap.
 * @param {ArrayLike<number>} counts
 * @returns {number}
 */
export function otsu(counts) {
  const all = Array.from(counts);
  const count = all.reduce((sum, n) => sum + n, 0);
  const total = all.reduce((sum, n, k) => sum + n * k, 0);
  let below = 0;
  let sum = 0;
  let best = -1;
  let first = 0;
  let last = 0;
  all.forEach((n, k) => {
    below += n;
    sum += n * k;
    const above = count - below;
    if (!below || !above) return;
    const between = below * above * (sum / below - (total - sum) / above) ** 2;
    if (between > best * (1 + 1e-12)) {
      best = between;
      first = k;
    }
    if (between >= best * (1 - 1e-12)) last = k;
  });
  return (first + last) / 2 + 1;
}
