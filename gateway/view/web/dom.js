// Helpers that create and update elements of the page.

export function element(tag, text, className) {
  const it = document.createElement(tag);
  if (text !== undefined) it.textContent = text;
  if (className) it.className = className;
  return it;
}

// A button with a text, a name for screen readers, and a title.
export function button(text, label, click, title = label) {
  const it = element("button", text);
  Object.assign(it, { type: "button", title, onclick: click });
  it.setAttribute("aria-label", label);
  return it;
}

// Makes the content of a box equal to these elements, and keeps elements that are equal already: drawing text again is
// expensive in software, and would remove a user's selection. What handles events does not belong here: it stays that of before.
export function show(box, fresh) {
  while (box.childNodes.length > fresh.length) box.lastChild.remove();
  fresh.forEach((it, at) => {
    const old = box.childNodes[at];
    if (!old) return box.append(it);
    if (old.isEqualNode(it)) return;
    if (old.nodeType !== Node.ELEMENT_NODE || old.nodeName !== it.nodeName || [...old.attributes].some(({ name }) => !it.hasAttribute(name))) return old.replaceWith(it);
    for (const { name, value } of it.attributes) if (old.getAttribute(name) !== value) old.setAttribute(name, value);
    show(old, [...it.childNodes]);
  });
}

// A table of rows [name, value, class of the value].
export function table(rows) {
  const it = element("table");
  for (const [name, value, className] of rows) {
    const row = element("tr"), head = element("th", name);
    head.scope = "row";
    row.append(head, element("td", value, className));
    it.append(row);
  }
  return it;
}
