"use strict";
// What the scripts of all pages share. Foreign text goes in as text or as an attribute, never as markup.
const SVG = "http://www.w3.org/2000/svg";
function fill(node, properties, children) {
  for (const [name, value] of Object.entries(properties || {})) {
    if (value === null || value === undefined || value === false) continue;
    node.setAttribute(name, value === true ? "" : String(value));
  }
  for (const child of children) if (child !== null) node.append(child);
  return node;
}
const make = (tag, properties, ...children) => fill(document.createElement(tag), properties, children);
const draw = (tag, properties, ...children) => fill(document.createElementNS(SVG, tag), properties, children);
const words = (token) => String(token).replaceAll("_", " ");
const byId = (id) => document.getElementById(id);
const show = (id, ...children) => byId(id).replaceChildren(...children.filter((child) => child !== null));
const pageData = () => JSON.parse(byId("data").textContent);
const bytesOf = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
const colorOf = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
