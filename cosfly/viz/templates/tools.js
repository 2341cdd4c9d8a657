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
function bytesOf(base64) {
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i += 1) bytes[i] = text.charCodeAt(i);
  return bytes;
}
const floatsOf = (base64) => new Float32Array(bytesOf(base64).buffer);  // little-endian, as every browser's machine
const colorOf = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
