// Gaussians are drawn from the farthest to the nearest. A worker sorts, so that moving stays smooth.

/** Sort Gaussians by depth, the farthest first; depth is measured along `forward`.
 *  It uses nothing but its arguments, as the worker gets a copy of its text. */
function sortByDepth(centres, members, forward) {
  const buckets = 65536, depths = new Float32Array(members.length);
  let low = Infinity, high = -Infinity;
  for (let i = 0; i < members.length; i++) {
    const at = 3 * members[i];
    const depth = forward[0] * centres[at] + forward[1] * centres[at + 1]
      + forward[2] * centres[at + 2];
    depths[i] = depth;
    if (depth < low) low = depth;
    if (depth > high) high = depth;
  }
  const starts = new Uint32Array(buckets + 1), scale = (buckets - 1) / (high - low || 1);
  const bucket = i => buckets - 1 - ((depths[i] - low) * scale | 0);
  for (let i = 0; i < members.length; i++) starts[bucket(i) + 1]++;
  for (let i = 0; i < buckets; i++) starts[i + 1] += starts[i];
  const order = new Uint32Array(members.length);
  for (let i = 0; i < members.length; i++) order[starts[bucket(i)]++] = members[i];
  return order;
}

/** What runs in the worker: sets of Gaussians arrive once, directions of view again and again. */
function workerMain() {
  const sets = new Map();
  onmessage = ({ data }) => {
    if (data.centres) sets.set(data.id, data);
    const { centres, members } = sets.get(data.id);
    if (!data.forward) return;
    const order = sortByDepth(centres, members, data.forward);
    postMessage({ id: data.id, order, forward: data.forward }, [order.buffer]);
  };
}

/** Start the worker; `receive` gets each order. A page from a file may start one from a blob only. */
function startSorter(receive) {
  const text = `"use strict"; ${sortByDepth}\n(${workerMain})();`;
  const address = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
  const worker = new Worker(address);
  worker.onmessage = ({ data }) => receive(data);
  return worker;
}
