// The panel of a page, in a function of K3D's own that has K3DInstance; `words` says what it holds, see page.py.
const style = document.createElement("style");
style.textContent = `
  body { font: 13px/1.4 system-ui, sans-serif; color: #1d2530; }
  #panel { position: absolute; left: 12px; top: 12px; max-width: 300px; max-height: calc(100% - 48px); overflow: auto;
    background: #fffffff0; border: 1px solid #d5dae2; border-radius: 6px; padding: 10px 14px; z-index: 10; }
  #panel h1 { font-size: 15px; margin: 0 0 4px; }
  #panel fieldset { border: 0; padding: 0; margin: 8px 0 0; }
  #panel legend { font-weight: 600; padding: 0; }
  #panel label { display: block; cursor: pointer; }
  #panel i { display: inline-block; width: 10px; height: 10px; border-radius: 5px; margin: 0 5px 0 2px; }
  #panel select { max-width: 100%; font: inherit; }
  #canvasTarget > div > div { padding: 0 5px !important; border-radius: 3px !important; font-weight: 600; }`;
document.head.append(style);

const element = (name, properties = {}, ...children) => {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
};

const shown = new Map(words.controls.map((control) => [control.key, new Set(control.shown)]));
const objects = K3DInstance.getWorld().ObjectsListJson;
const show = () => {
  for (const { id, ...tags } of words.tags) {
    const visible = Object.entries(tags).every(([key, value]) => !shown.has(key) || shown.get(key).has(value));
    if (objects[id].visible !== visible) {
      objects[id].visible = visible;
      K3DInstance.reload(objects[id], { visible }, true);
    }
  }
  K3DInstance.render();
};

// The ground by how many of the ticked cameras see it; each is a bit of `seenBy`, by triangle.
const paint = () => {
  const cameras = words.controls.find(({ key }) => key === "camera").values;
  const ticked = cameras.reduce((bits, name, k) => bits | (shown.get("camera").has(name) && k < 31 ? 1 << k : 0), 0);
  for (const [id, seenBy] of Object.entries(words.seenBy)) {
    const { colors } = objects[id];
    seenBy.forEach((bits, k) => {
      let count = 0;
      for (let left = bits & ticked; left; left &= left - 1) count += 1;
      colors.data.fill(words.palette[Math.min(count, words.palette.length - 1)], 3 * k, 3 * k + 3);
    });
    K3DInstance.reload(objects[id], { colors }, true);
  }
};

const panel = element("div", { id: "panel" }, element("h1", { textContent: words.title }));
for (const line of words.lines) panel.append(element("div", { textContent: line }));
for (const { key, label, kind, values, colours } of words.controls) {
  const group = element("fieldset", {}, element("legend", { textContent: label }));
  if (kind === "one") {
    const select = element("select", { ariaLabel: label });
    for (const value of values) select.append(new Option(value, value, false, shown.get(key).has(value)));
    select.onchange = () => {
      shown.set(key, new Set([select.value]));
      show();
    };
    group.append(select);
  } else {
    values.forEach((value, k) => {
      const box = element("input", { type: "checkbox", checked: shown.get(key).has(value) });
      box.onchange = () => {
        if (box.checked) shown.get(key).add(value);
        else shown.get(key).delete(value);
        if (key === "camera") paint();
        show();
      };
      const dot = element("i");
      if (colours[k]) dot.style.background = colours[k];
      group.append(element("label", {}, box, ...(colours[k] ? [dot] : []), value));
    });
  }
  panel.append(group);
}
document.body.append(panel);
show();
// names have places only after somebody has set the camera
setTimeout(() => {
  K3DInstance.setCamera(words.camera);
  K3DInstance.render(true);
}, 100);
