// The 3D view: one surface per measurement, shown or hidden one by one, coloured by the chosen quantity.
"use strict";
(function () {
  const data = JSON.parse(document.getElementById("view-data").textContent);
  const view = document.getElementById("view3d");
  const state = { mode: document.querySelector("input[name=mode]:checked").value, shown: data.traces.map((t) => t.group === data.groups[0]) };

  function colours(trace, mode) {
    if (mode === "texture") return { surfacecolor: trace.grey, colorscale: [[0, "#101214"], [1, "#f4f4f2"]] };
    if (mode === "error") return { surfacecolor: trace.error, colorscale: data.error_scale };
    return { surfacecolor: trace.grey, colorscale: [[0, trace.colour], [1, trace.colour]] };
  }

  const eye = data.camera.eye, up = data.camera.up;
  const left = [up[1] * eye[2] - up[2] * eye[1], up[2] * eye[0] - up[0] * eye[2], up[0] * eye[1] - up[1] * eye[0]];
  const [x, y, z] = [0, 1, 2].map((i) => 1e4 * (0.6 * eye[i] + 0.9 * up[i] - 0.6 * left[i]));
  // plotly takes the normal of the grid's rows and columns, which points away from the camera that took them.
  const light = { x: -x, y: -y, z: -z };

  function traces() {
    let bar = state.mode === "error";
    return data.traces.map((trace, i) => {
      const out = Object.assign({
        type: "surface", name: trace.name, x: trace.x, y: trace.y, z: trace.z, cmin: 0, cmax: 255,
        visible: state.shown[i], showscale: false, connectgaps: false, hoverinfo: "name",
        contours: { x: { highlight: false }, y: { highlight: false }, z: { highlight: false } },
        lighting: state.mode === "measurement"
          ? { ambient: 0.5, diffuse: 0.75, specular: 0.1, roughness: 0.7 }
          : { ambient: 0.95, diffuse: 0.1, specular: 0.0 },
        // From behind the viewer's left shoulder.
        lightposition: light,
      }, colours(trace, state.mode));
      if (bar && state.shown[i]) {
        bar = false;
        out.showscale = true;
        out.colorbar = {
          title: { text: "mm", side: "top" }, tickvals: data.error_ticks, ticktext: data.error_labels,
          len: 0.5, thickness: 12, x: 0.98, outlinewidth: 0,
        };
      }
      return out;
    });
  }

  const axis = { title: { text: "" }, showspikes: false, gridcolor: "#e3e6e8", zeroline: false, showbackground: false,
                 tickfont: { size: 10, color: "#6b757d" } };
  const layout = {
    margin: { l: 0, r: 0, t: 0, b: 0 }, uirevision: "keep", showlegend: false, paper_bgcolor: "#ffffff",
    scene: {
      aspectmode: "data", uirevision: "keep",
      camera: {
        eye: { x: data.camera.eye[0], y: data.camera.eye[1], z: data.camera.eye[2] },
        up: { x: data.camera.up[0], y: data.camera.up[1], z: data.camera.up[2] },
        projection: { type: "orthographic" },
      },
      xaxis: Object.assign({}, axis, { title: { text: "x [mm]" } }),
      yaxis: Object.assign({}, axis, { title: { text: "y [mm]" } }),
      zaxis: Object.assign({}, axis, { title: { text: "z [mm]" } }),
    },
  };
  const config = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["hoverClosest3d"] };

  function draw() { return Plotly.react(view, traces(), layout, config); }

  document.querySelectorAll("input[name=mode]").forEach((input) =>
    input.addEventListener("change", () => { state.mode = input.value; draw(); }));
  document.querySelectorAll("input[data-measurement]").forEach((input) => {
    const i = Number(input.dataset.measurement);
    input.checked = state.shown[i];
    input.addEventListener("change", () => { state.shown[i] = input.checked; draw(); });
  });
  Plotly.newPlot(view, traces(), layout, config).then(() => { view.dataset.ready = "yes"; });
})();
