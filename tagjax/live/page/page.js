"use strict";
// The page asks for the next frame once it has drawn the last: a slow browser skips frames, and nothing queues up.
const find = (name) => document.getElementById(name);
const canvas = document.querySelector("canvas"), pen = canvas.getContext("2d");
const signs = { detected: "●", not_read: "✕", occluded: "◐", stationary: "■", not_found: "?", unknown: "?" };
const marks = { detected: "● ", lost: "○ ", alarm: "▲ ", left: "▲ " };
const decoder = new TextDecoder();
const rows = new Map();
let stream = "", after = 0, drawnEvents = "", title = document.title;

function write(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

function make(name, style, ...children) {
  const node = document.createElement(name);
  if (style) node.className = style;
  node.append(...children);
  return node;
}

function state(text, style) {
  write(find("state"), text);
  find("state").className = style;
  document.body.classList.toggle("stale", style !== "");
}

function newRow(tag) {
  const row = {
    epc: make("span"), sign: make("span", "sign"), text: make("span"), fill: make("i"), confidence: make("span"),
    distance: make("td", "distance"), reads: make("td", "reads"), key: make("span"),
  };
  const head = make("th", "", row.key, row.epc);
  head.scope = "row";
  row.key.setAttribute("aria-hidden", "true");
  row.sign.setAttribute("aria-hidden", "true");
  const bar = make("span", "bar", row.fill);
  bar.setAttribute("aria-hidden", "true");
  row.line = make("tr", "", head, make("td", "status", row.sign, row.text), make("td", "confidence", bar, row.confidence), row.distance, row.reads);
  write(row.epc, tag.epc);
  rows.set(tag.epc, row);
  return row;
}

function showTags(tags) {
  const there = new Set(tags.map((tag) => tag.epc));
  for (const [epc, row] of rows) {
    if (!there.has(epc)) { row.line.remove(); rows.delete(epc); }
  }
  tags.forEach((tag, number) => {
    const row = rows.get(tag.epc) || newRow(tag);
    if (find("tags").children[number] !== row.line) find("tags").insertBefore(row.line, find("tags").children[number] || null);
    row.key.className = `key s${tag.colour}`;
    row.line.className = tag.detected ? "" : "off";
    write(row.sign, signs[tag.status] || "?");
    write(row.text, tag.text);
    const confidence = tag.confidence === null ? 0 : tag.confidence;
    row.fill.style.width = `${Math.round(100 * Math.min(Math.max(confidence, 0), 1))}%`;
    write(row.confidence, tag.confidence === null ? "–" : tag.confidence.toFixed(2));
    write(row.distance, tag.distance_m === null ? "" : `${tag.distance_m.toFixed(2)} m`);
    write(row.reads, tag.reads_hz.toFixed(0));
  });
  find("none").hidden = tags.length > 0;
}

function showEvents(events) {
  const key = JSON.stringify(events);
  if (key === drawnEvents) return;
  drawnEvents = key;
  find("events").replaceChildren(...events.map((event) => make(
    "li", event.kind,
    make("time", "", `${event.at_s.toFixed(1)} s`),
    make("span", "", marks[event.kind] || "", make("code", "", event.epc), ` ${event.text}`),
  )));
  find("quiet").hidden = events.length > 0;
}

function show(now) {
  write(find("rate"), now.frames_per_s.toFixed(1));
  write(find("latency"), now.latency_ms === null ? "–" : `${now.latency_ms.toFixed(0)} ms`);
  write(find("dropped"), String(now.dropped_frames));
  write(find("reads"), now.reads_hz.toFixed(0));
  showTags(now.tags);
  showEvents(now.events);
  const notes = find("notes");
  if (notes.dataset.text !== now.notes.join("\n")) {
    notes.dataset.text = now.notes.join("\n");
    notes.replaceChildren(...now.notes.map((note) => make("li", "", note)));
  }
  const alarms = now.events.filter((event) => event.kind === "alarm").length;
  document.title = alarms ? `(▲ ${alarms}) ${title}` : title;
}

async function draw(bytes) {
  const picture = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
  if (canvas.width !== picture.width || canvas.height !== picture.height) {
    canvas.width = picture.width;
    canvas.height = picture.height;
  }
  pen.drawImage(picture, 0, 0);
  picture.close();
}

async function next() {
  const answer = await fetch(`frame?stream=${stream}&after=${after}`, { cache: "no-store", signal: AbortSignal.timeout(20000) });
  if (answer.status === 204) {
    const starting = answer.headers.get("Tagjax-State") === "starting";
    return starting ? state("starting: the tracer is compiled first", "starting") : state("no new frame", "wrong");
  }
  if (answer.status === 410) throw new Error("ended");
  if (!answer.ok) throw new Error(`answer ${answer.status}`);
  const bytes = await answer.arrayBuffer();
  const length = new DataView(bytes).getUint32(0);
  const now = JSON.parse(decoder.decode(new Uint8Array(bytes, 4, length)));
  await draw(new Uint8Array(bytes, 4 + length));
  stream = answer.headers.get("Tagjax-Stream") || "";
  after = now.number;
  show(now);
  state(`live, ${now.time_s.toFixed(1)} s`, "");
  canvas.dataset.frame = now.number;
}

const wait = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
const visible = () => new Promise((resolve) => {
  if (!document.hidden) return resolve();
  document.addEventListener("visibilitychange", resolve, { once: true });
});

(async () => {
  let ended = false;
  for (;;) {
    await visible();
    try {
      await next();
      ended = false;
    } catch (error) {
      ended = ended || error.message === "ended";
      state(ended ? "the stream has ended" : "no connection; trying again", ended ? "ended" : "wrong");
      await wait(1000);
    }
  }
})();
