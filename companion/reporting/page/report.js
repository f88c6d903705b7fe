"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const COLOURS = ["#1f4fa3", "#c2410c", "#1c7a38", "#7b2d8e", "#8a6d00", "#00727a"];

function draw(box) {
  const plot = data.plots[Number(box.dataset.plot)];
  const series = [{ label: data.abscissa }];
  const values = [plot.x];
  plot.curves.forEach((curve, i) => {
    series.push({ label: curve.label, stroke: COLOURS[i % COLOURS.length], width: 1.4,
      spanGaps: false,
      ...(plot.joined ? {} : { paths: () => null }),
      points: { show: !plot.joined || plot.x.length < 400, size: plot.joined ? 4 : 8 } });
    values.push(curve.values);
  });
  if (plot.limit !== null) {
    series.push({ label: "limit", stroke: "#b3261e", dash: [6, 4], width: 1, points: { show: false } });
    values.push(plot.x.map(() => plot.limit));
  }
  const size = { width: Math.min(box.clientWidth, 1068), height: 240 };
  const chart = new uPlot({ ...size, series, scales: { x: { time: false } },
    axes: [{ label: data.abscissa, labelSize: 22 }, { size: 60 }] }, values, box);
  addEventListener("resize", () => chart.setSize({ width: Math.min(box.clientWidth, 1068), height: 240 }));
}
document.querySelectorAll(".plot").forEach(draw);

const sheets = [...document.querySelectorAll(".overlay")];
const which = document.getElementById("which"), share = document.getElementById("share");
function show() {
  sheets.forEach((sheet, i) => {
    sheet.dataset.hidden = String(Number(i !== Number(which.value)));
    sheet.querySelector(".top").style.clipPath = `inset(0 0 0 ${share.value}%)`;
  });
}
if (which) {
  which.addEventListener("input", show);
  share.addEventListener("input", show);
  show();
}
