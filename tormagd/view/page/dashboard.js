"use strict";
// The page of tormagctl dashboard: it shows frames (tormagd/view/frame.py), live or of a recording. Where the link that
// is printed has a secret, it also operates. Colours here are those of light and paper; dashboard.css turns them in the dark.

const CURVES = ["asked_N", "governed_N", "measured_N", "gap_mm", "gap_wanted_mm", "field_mT"];
const DIGITS = {asked_N: 3, governed_N: 3, measured_N: 3, gap_mm: 2, field_mT: 1};
const COLOURS = {black: "#222", blue: "#0072b2", orange: "#e69f00", sky: "#56b4e9", green: "#007a59", red: "#d32f2f"};
const PATH_S = 2;
const QUESTIONS = {
  pause: "Pause? The gap is held where it is.",
  resume: "Resume? The force changes at once: warn whoever holds the handle.",
  disable: "Disable? The gap opens, and the drives are turned off.",
  arm: "Arm? It homes if needed, and the force ramps up: warn whoever holds the handle.",
};
// the address bar shows no secret, and a bookmark keeps none; a reload of this tab finds it here
if (location.hash) {
  sessionStorage.secret = location.hash.slice(1);
  history.replaceState(null, "", location.pathname);
}
addEventListener("hashchange", () => location.reload());
const secret = sessionStorage.secret ?? "";

const at = (id) => document.getElementById(id);
const kept = {t_s: [], ...Object.fromEntries(CURVES.map((name) => [name, []]))};
let about, explained = {limits: {}, faults: {}}, portrait = null, charts = {}, notGranted = [];

// ---- charts

// at least so wide that noise does not look like a signal
const atLeast = (least) => (u, low, high) => {
  if (low === null) return [0, least];
  const wider = Math.max(least - (high - low), 0.1 * (high - low)) / 2;
  return [low - wider, high + wider];
};
const axis = (more) => ({stroke: "#666", grid: {stroke: "#eee"}, ticks: {show: false}, size: 54, ...more});

const edge = (stroke) => ({stroke, width: 1, points: {show: false}});

function chart(id, height, options, data) {
  const place = at(id).querySelector("div") ?? at(id);
  const size = () => ({width: Math.max(place.clientWidth, 200), height});
  const made = new uPlot({
    ...size(), legend: {live: false}, cursor: {show: false}, ...options,
  }, data, place);
  new ResizeObserver(() => made.setSize(size())).observe(place);
  return made;
}

const timeScale = () => {
  const end = kept.t_s.length ? seconds(kept.t_s.at(-1)) : 0;
  return [end - about.shown_s, end];
};
const timeAxis = () => axis({size: 36, values: (u, splits) => splits.map((s) => `${+s.toFixed(2)} s`)});

function makeCharts() {
  const time = {time: false, range: timeScale};
  charts.force = chart("force", 330, {
    scales: {x: time, y: {range: atLeast(0.05)}},
    axes: [timeAxis(), axis()],
    series: [
      {},
      {label: "measured", stroke: COLOURS.orange, width: 1.5},
      {label: "governed", stroke: COLOURS.blue, width: 2},
      {label: "asked", stroke: COLOURS.black, width: 1.2, dash: [6, 4]},
    ],
  }, [[], [], [], []]);
  charts.gap = chart("gap", 250, {
    scales: {x: time, y: {range: atLeast(0.5)}, field: {range: atLeast(2)}},
    axes: [timeAxis(), axis(), axis({side: 1, scale: "field", stroke: COLOURS.green, grid: {show: false}})],
    series: [
      {},
      {label: "gap", stroke: COLOURS.sky, width: 3},
      {label: "gap wanted", stroke: COLOURS.black, width: 1},
      {label: "field", scale: "field", stroke: COLOURS.green, width: 1.5, dash: [6, 4]},
    ],
  }, [[], [], [], []]);
  charts.portrait = chart("portrait", 300, {
    legend: {show: false},
    scales: {x: {time: false, range: portraitForces}, y: {range: portraitRates}},
    axes: [axis({size: 36}), axis()],
    series: [{}, edge(COLOURS.green), edge(COLOURS.green)],
    bands: [{series: [1, 2], fill: "#cfe8df"}],
    hooks: {draw: [drawPath]},
  }, [[], [], []]);
}

// ---- the phase portrait

const rate = (forces, i, j) => (forces[j] - forces[i]) / (kept.t_s[j] - kept.t_s[i]);
const known = (...values) => values.every((value) => value !== null && value !== undefined);

// points (force, change of force) of the newest seconds, oldest first
function path(forces) {
  const points = [], last = kept.t_s.length - 1;
  for (let i = 1; i < last; i++) {
    if (kept.t_s[i] > kept.t_s[last] - PATH_S && known(forces[i - 1], forces[i], forces[i + 1])) {
      points.push([forces[i], rate(forces, i - 1, i + 1)]);
    }
  }
  return points;
}

// around the forces of the time shown, or the whole of it before there are any
function portraitForces() {
  const shown = [...kept.asked_N, ...kept.governed_N].filter((force) => known(force));
  const forces = shown.length ? shown : portrait?.force_N ?? [0];
  return atLeast(1)(null, Math.min(...forces), Math.max(...forces));
}

function portraitRates() {
  const [, most_N] = portraitForces();
  const renderable = portrait?.rate_N_s.filter((rate_N_s, i) => portrait.force_N[i] <= most_N) ?? [];
  const most = 1.15 * Math.max(1, ...renderable, ...path(kept.asked_N).map(([, change]) => Math.abs(change)));
  return [-most, most];
}

function drawPath(u) {
  const {ctx, bbox} = u, place = ([force, change]) => [u.valToPos(force, "x", true), u.valToPos(change, "y", true)];
  const asked = path(kept.asked_N).map(place), now = path(kept.governed_N).map(place).at(-1);
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  ctx.beginPath();
  asked.forEach(([x, y], i) => (i ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
  ctx.lineWidth = 1.5 * devicePixelRatio;
  ctx.strokeStyle = COLOURS.black;
  ctx.stroke();
  if (now) {
    ctx.beginPath();
    ctx.arc(...now, 6 * devicePixelRatio, 0, 2 * Math.PI);
    ctx.fillStyle = COLOURS.blue;
    ctx.fill();
  }
  ctx.restore();
}

// without a portrait, as of an older daemon, the path alone
function showPortrait() {
  const rates = portrait?.rate_N_s ?? [null, null];
  charts.portrait.setData([portrait?.force_N ?? portraitForces(), rates, rates.map((most) => most && -most)]);
}

// ---- what stands around them

function element(name, text, ...classes) {
  const made = document.createElement(name);
  made.textContent = text;
  made.classList.add(...classes);
  return made;
}

// what stands in backticks is code
function withCode(text) {
  return text.split("`").map((part, i) => (i % 2 ? element("code", part) : part));
}

function code(name, label, kind) {
  const made = element("div", "", kind), why = explained[kind === "fault" ? "faults" : "limits"][name];
  made.append(element("b", name), label);
  if (why) {
    const next = element("em", "Next: ");
    next.append(...withCode(why.remedy));
    made.append(": ", ...withCode(why.cause), next);
  }
  return made;
}

function showCodes(frame) {
  const percent = (share) => (share < 0.01 ? "under 1%" : `${Math.round(100 * share)}%`);
  const codes = [
    ...frame.faults.map((name) => code(name, "fault", "fault")),
    ...frame.held.map((limit) => code(limit.code, `${percent(limit.share)} of the time shown`,
      limit.is_now ? "now" : "before")),
    ...notGranted.map((each) => element("div", `The kernel did not grant ${each}. Next: tormagctl doctor`, "now")),
  ];
  at("codes").replaceChildren(...codes.length ? codes : [element("div", "No fault, and nothing holds the force back.")]);
}

function showState(frame) {
  at("state").textContent = frame.operating_state || "state not recorded";
  at("state").className = frame.operating_state;
  for (const [name, digits] of Object.entries(DIGITS)) {
    const newest = kept[name].at(-1);
    at(name).textContent = known(newest) ? newest.toFixed(digits) : "–";
  }
}

function showLate(counts) {
  const edges = about.late_us, most = Math.log1p(Math.max(1, ...counts));
  at("late").querySelector("table").replaceChildren(...counts.map((count, i) => {
    const row = document.createElement("tr"), bar = document.createElement("div"), cell = document.createElement("td");
    bar.style.width = `${100 * Math.log1p(count) / most}%`;
    cell.append(bar);
    const range = i === 0 ? `under ${edges[0]}` : i === edges.length ? `over ${edges[i - 1]}` : `${edges[i - 1]} to ${edges[i]}`;
    row.append(element("td", range), cell, element("td", count));
    return row;
  }));
}

// an older daemon and a recording of ticks alone say nothing of it
function showBelief(believed) {
  const told = Object.entries(believed).map((each) => each.join(" "));
  at("believed").textContent = told.length ? `Believed of the device: ${told.join(", ")}.` : "";
}

// ---- frames

const seconds = (t_s) => t_s - (about.start_s ?? kept.t_s.at(-1));

function show(frame) {
  const x = kept.t_s.map(seconds);
  showState(frame);
  showCodes(frame);
  showLate(frame.late_counts);
  showBelief(frame.believed);
  charts.force.setData([x, kept.measured_N, kept.governed_N, kept.asked_N]);
  charts.gap.setData([x, kept.gap_mm, kept.gap_wanted_mm, kept.field_mT]);
  showPortrait();
}

// what was true before is no longer green
function showSilence(why) {
  at("silence").textContent = why;
  at("state").className = "";
}

function live() {
  const acts = {}, on = (name, act) => { acts[name] = act; };
  const stream = new WebSocket(new URL("live", location).href.replace("http", "ws"), ["tormag", ...(secret ? [secret] : [])]);
  stream.onopen = () => { for (const name of Object.keys(kept)) kept[name] = []; };
  stream.onmessage = ({data}) => Object.entries(JSON.parse(data)).forEach(([name, value]) => acts[name](value));
  stream.onclose = () => {
    showSilence("tormagctl dashboard has ended, or restarts: open the link that it prints");
    setTimeout(live, 1000);
  };
  on("frame", (frame) => {
    at("silence").textContent = "";
    for (const name of Object.keys(kept)) kept[name].push(...frame[name]);
    const old = kept.t_s.findIndex((t_s) => t_s > kept.t_s.at(-1) - about.shown_s);
    for (const values of Object.values(kept)) values.splice(0, old);
    show(frame);
  });
  on("explained", (newest) => { explained = newest; });
  on("status", (status) => {
    notGranted = status.not_granted;
    const lever = status.roller_radius_mm === null ? "" : `, 1 N is ${status.roller_radius_mm} mNm of the handle`;
    at("scene").textContent = `scene ${status.scene}${lever}${status.is_homed ? "" : ", not homed"}`;
    at("source").textContent = `tormagd ${status.version}, device ${status.link.state} on ${status.link.port}`;
    const how = status.following, mN = (force_N) => (1e3 * force_N).toFixed(0);
    at("following").hidden = !how;
    if (how) {
      at("followed").textContent = mN(how.rms_N);
      at("aligned").textContent = how.delay_ms
        ? `${mN(how.aligned_rms_N)} with a delay of ${how.delay_ms.toFixed(0)} ms taken out` : "without a delay";
    }
    const played = status.setpoints.playout, ms = (us) => (1e-3 * us).toFixed(1);
    at("playout").textContent = played ? `Playout ${played.playout_ms} ms after the stamp: adds ${ms(played.held_us.p50)} ms, `
      + `takes out ${ms(played.jitter_us)} ms of jitter, ${played.late} of ${played.setpoints} came too late.` : "";
    const {control} = status.rates, late = control?.lateness_us;
    at("rates").textContent = "Of every twentieth tick of 20 s, bars as logarithms. " + (control ? `Of all: ${control.hz.toFixed(0)} Hz, `
      + `p50 ${late.p50.toFixed(0)}, p99 ${late.p99.toFixed(0)}, longest ${late.max.toFixed(0)} µs; ${control.stalls} stalls.` : "");
  });
  on("portrait", (told) => { portrait = told; });
  on("silence", ({seconds: silent_s, why}) => {
    showSilence(`nothing heard for ${silent_s.toFixed(0)} s ${why}`);
  });
}

// ---- operating

async function give(command) {
  const say = (text, isBad) => { at("answer").textContent = text; at("answer").className = isBad ? "bad" : ""; };
  say(`${command} …`);
  try {
    const answer = await fetch("command", {
      method: "POST",
      headers: {"Content-Type": "application/json", "Tormag-Secret": secret},
      body: JSON.stringify({command}),
    });
    say(`${command}: ${await answer.text()}`, !answer.ok);
  } catch (error) {
    say(`${command} was not sent: tormagctl dashboard does not answer. Next: tormagctl ${command}`, true);
  }
}

// the question is not modal: STOP stays within reach
function operate() {
  let asked = null;
  at("operate").hidden = false;
  document.body.classList.add("operates");
  for (const button of document.querySelectorAll("[data-command]")) {
    button.addEventListener("click", () => {
      asked = button.dataset.command;
      at("question").close();
      if (asked === "stop") { give(asked); return; }
      at("asked").textContent = QUESTIONS[asked];
      at("question").show();
    });
  }
  at("yes").addEventListener("click", () => { at("question").close(); give(asked); });
  at("no").addEventListener("click", () => at("question").close());
}

// ---- a recording

function spans(u, stretches, colour) {
  u.ctx.fillStyle = colour;
  for (const [from, to] of stretches) {
    const left = u.valToPos(from, "x", true);
    u.ctx.fillRect(left, u.bbox.top, Math.max(u.valToPos(to, "x", true) - left, devicePixelRatio), u.bbox.height);
  }
}

function recording() {
  const {overview, duration_s} = about, slider = at("at");
  let asked = 0, timer = null;
  at("recording").hidden = false;
  explained = about.explained;
  at("scene").textContent = about.scene && `scene ${about.scene}`;
  const followed = about.followed && `, followed ${about.followed}`;
  at("source").textContent = `${about.name}, ${new Date(1e3 * about.start_s).toLocaleString()}${followed}`;
  at("silence").textContent = about.notes.join("; ");
  at("rates").textContent = "Of the ticks recorded in the 20 s shown, bars as logarithms.";
  portrait = about.portrait;
  const strip = chart("overview", 120, {
    legend: {show: false},
    scales: {x: {time: false, range: [0, duration_s]}, y: {range: atLeast(0.05)}},
    axes: [timeAxis(), axis()],
    series: [{}, edge(COLOURS.orange), edge(COLOURS.orange)],
    bands: [{series: [2, 1], fill: COLOURS.orange}],
    hooks: {
      drawClear: [(u) => { spans(u, overview.limits, "#fff3d6"); spans(u, overview.faults, "#f6b9b4"); }],
      draw: [(u) => {
        spans(u, overview.marks.map(([at_s]) => [at_s, at_s]), COLOURS.blue);
        spans(u, [[Number(slider.value), Number(slider.value)]], COLOURS.black);
      }],
    },
  }, [overview.t_s, overview.low_N, overview.high_N]);

  async function seek(at_s) {
    at_s = Number(at_s);
    slider.value = at_s;  // it rounds to its steps, and a fault may begin between two
    const marked = overview.marks.filter(([mark_s]) => mark_s <= at_s && mark_s > at_s - about.shown_s);
    at("moment").textContent = [`${at_s.toFixed(2)} of ${duration_s.toFixed(2)} s`,
      ...marked.map(([mark_s, text]) => `${mark_s.toFixed(2)} s: ${text}`)].join("; ");
    strip.redraw(false, false);
    const number = ++asked, frame = await (await fetch(`frame?at_s=${at_s}`)).json();
    if (number !== asked) return;  // a newer one is on its way
    for (const name of Object.keys(kept)) kept[name] = frame[name];
    show(frame);
  }
  function stop() {
    clearInterval(timer);
    timer = null;
    at("play").textContent = "Play";
  }
  slider.max = duration_s;
  slider.addEventListener("input", () => { stop(); seek(slider.value); });
  strip.over.addEventListener("pointerdown", (event) => { stop(); seek(strip.posToVal(event.offsetX, "x")); });
  at("play").addEventListener("click", () => {
    if (timer !== null) { stop(); return; }
    let at_s = Number(slider.value) < duration_s ? Number(slider.value) : 0;
    at("play").textContent = "Pause";
    timer = setInterval(() => {
      at_s = Math.min(at_s + 0.1, duration_s);
      seek(at_s);
      if (at_s === duration_s) stop();
    }, 100);
  });
  seek(overview.faults.length ? Math.min(...overview.faults.map(([from]) => from)) : duration_s);
}

async function start() {
  const answer = await fetch("about", {headers: {"Tormag-Secret": secret}});
  if (!answer.ok) { showSilence(await answer.text()); return; }
  about = await answer.json();
  if (about.operates) operate();
  makeCharts();
  if (about.kind === "live") live(); else recording();
}

start();
