// The last ten minutes, one sample a second.
const KEPT = 600;
const KINDS = [
  ["how sure, m", ["sigma_m", "hpl_m"]],
  ["vision against GNSS, m", ["residual_m"]],
  ["latency, ms", ["reference", "extract", "register", "latency"]],
  ["quality", ["quality"]],
  ["rate, Hz", ["rate_hz"]],
  ["processor, % of a core", ["cpu_percent"]],
  ["temperature, °C", ["temperature_c"]],
];
const COLOURS = ["#0b4f9e", "#b03a00", "#0b6b2e", "#6d2382"];

export class Plots {
  constructor(box) {
    this.box = box;
    this.samples = [];
    this.charts = [];
  }

  add(sample, draw = true) {
    const last = this.samples.at(-1);
    if (last && sample.t - last.t < 0.95) return;
    this.samples.push(sample);
    while (this.samples.length > KEPT) this.samples.shift();
    if (draw && this.isShown) this.draw();
  }

  clear() { this.samples = []; }

  get isShown() { return this.box.offsetParent !== null; }

  resize() {
    this.draw();
  }

  draw() {
    if (!this.isShown) return;
    if (!this.charts.length) this.make();
    const x = this.samples.map((s) => s.t);
    const width = Math.max(280, Math.floor(this.box.clientWidth / Math.max(1, Math.floor(this.box.clientWidth / 310))) - 8);
    KINDS.forEach(([, names], i) => {
      // What nobody told (no GNSS, a record without temperature) takes no room.
      this.charts[i].root.hidden = !this.samples.some((s) => names.some((n) => s[n] !== null && s[n] !== undefined));
      this.charts[i].setData([x, ...names.map((n) => this.samples.map((s) => s[n] ?? null))]);
      if (this.charts[i].width !== width) this.charts[i].setSize({ width, height: 150 });
    });
  }

  make() {
    const Chart = window.uPlot;
    this.charts = KINDS.map(([title, names]) => new Chart({
      title, width: 300, height: 150, legend: { show: names.length > 1, live: false },
      cursor: { show: false },
      series: [{}, ...names.map((label, i) => ({ label: label.replace("_m", "").replace("hpl", "HPL"), stroke: COLOURS[i], width: 1.5 }))],
      axes: [{ size: 30 }, { size: 54 }],
    }, [[], ...names.map(() => [])], this.box));
  }
}
