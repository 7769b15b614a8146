// The field at a point, from the numbers in the page: bilinear between cell centres, as the server answers.
const minus = (number) => number.replace("-", "−");

class Readout {
  constructor(data) {
    this.data = data;
    this.decoded = new Map();
  }

  // The values of one height, unpacked when first asked for: {mean: [Float32Array], sd: [...], layers: {name: ...}}.
  height(k) {
    if (!this.decoded.has(k)) this.decoded.set(k, this.decode(this.data.values[k]));
    return this.decoded.get(k);
  }

  async decode({ mean, sd, layers }) {
    const all = (packed) => Promise.all(packed.map((each) => this.unpack(each)));
    const names = Object.keys(layers), others = await all(Object.values(layers));
    return { mean: await all(mean), sd: await all(sd), layers: Object.fromEntries(names.map((n, i) => [n, others[i]])) };
  }

  async unpack({ low, step, data }) {
    const packed = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const view = new DataView(await new Response(stream).arrayBuffer());
    const values = new Float32Array(view.byteLength / 2);
    for (let i = 0, code = 0; i < values.length; i++) {
      code = (code + view.getUint16(2 * i, true)) & 0xffff;
      values[i] = code === 0 ? NaN : low + step * (code - 1);
    }
    return values;
  }

  // Cells around (x, y) in metres of the building, with their weights; null outside the map.
  around(x_m, y_m) {
    const { origin_m, resolution_m, shape } = this.data, [rows, columns] = shape;
    const u = (x_m - origin_m[0]) / resolution_m, v = (y_m - origin_m[1]) / resolution_m;
    if (!(u >= 0 && v >= 0 && u <= columns - 1 && v <= rows - 1)) return null;
    const i = Math.min(Math.floor(u), Math.max(columns - 2, 0)), j = Math.min(Math.floor(v), Math.max(rows - 2, 0));
    const fu = u - i, fv = v - j, cells = [];
    for (const [dj, wv] of [[0, 1 - fv], [1, fv]])
      for (const [di, wu] of [[0, 1 - fu], [1, fu]]) if (wu * wv > 0) cells.push([(j + dj) * columns + i + di, wu * wv]);
    return cells;
  }

  // {mean: [...], sd: [...], norm, norm_sd, layer} at a point; null where it is not measured. Call after height(k).
  at(values, x_m, y_m, layer) {
    const cells = this.around(x_m, y_m);
    if (cells === null) return null;
    const blend = (array, of = (v) => v) => cells.reduce((sum, [cell, weight]) => sum + weight * of(array[cell]), 0);
    const mean = values.mean.map((array) => blend(array));
    const sd = values.sd.map((array) => Math.sqrt(blend(array, (v) => v * v)));
    if (mean.some(Number.isNaN)) return null;
    const norm = Math.hypot(...mean), norm_sd = Math.hypot(...mean.map((m, c) => (m * sd[c]) / norm));
    return { mean, sd, norm, norm_sd, layer: values.layers[layer] ? blend(values.layers[layer]) : undefined };
  }

  // A point in words, a line each.
  words(values, x_m, y_m, layer) {
    const place = `x ${x_m.toFixed(2)} m, y ${y_m.toFixed(2)} m`, found = this.at(values, x_m, y_m, layer);
    if (found === null) return [place, "not measured"];
    const names = { bx: "Bx", by: "By", bz: "Bz", horizontal: "Horizontal", vertical: "Vertical" };
    const told = (name, mean, sd) => `${name} ${minus(mean.toFixed(1))} ± ${sd.toFixed(1)} µT`;
    const lines = [place, told("|B|", found.norm, found.norm_sd)];
    this.data.components.forEach((c, i) => names[c] && lines.push(told(names[c], found.mean[i], found.sd[i])));
    if (found.layer !== undefined) lines.push(this.layerWords(layer, found.layer));
    return lines;
  }

  layerWords(layer, value) {
    const { label, unit } = this.data.layers[layer];
    if (Number.isNaN(value)) return `${label}: too little measured to tell`;
    return `${label} ${minus(String(Number(value.toPrecision(3))))}${unit && " " + unit}`;
  }
}
