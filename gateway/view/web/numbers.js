// The numbers from 0 to 255 as one texture: 16 by 16 tiles of 128 by 64 pixels, with letters 48 pixels high.

export function atlas(gl) {
  const canvas = document.createElement("canvas"), [w, h] = [128, 64];
  [canvas.width, canvas.height] = [16 * w, 16 * h];
  const pen = canvas.getContext("2d", { willReadFrequently: true });
  pen.fillStyle = "#000";
  pen.fillRect(0, 0, canvas.width, canvas.height);
  pen.fillStyle = "#fff";
  pen.font = "600 48px system-ui, \"DejaVu Sans\", sans-serif";
  [pen.textAlign, pen.textBaseline] = ["center", "middle"];
  for (let i = 0; i < 256; i++) pen.fillText(String(i), (i % 16 + 0.5) * w, (Math.floor(i / 16) + 0.53) * h);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, gl.RED, gl.UNSIGNED_BYTE, canvas);
  gl.generateMipmap(gl.TEXTURE_2D);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
}
