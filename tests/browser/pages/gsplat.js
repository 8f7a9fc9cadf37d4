import { Camera, Matrix4, PLYLoader, Scene, WebGLRenderer } from 'gsplat'
import { canvas, drawUntil, readPixels } from './common.js'

// From OpenGL's axes of a camera to this viewer's, whose y points down and z forward.
const SIGNS = [1, -1, -1, 1]

// It has no settings.
export async function start() {
  const renderer = new WebGLRenderer(canvas, []) // without the pass that fades a file in
  let scene = null

  return {
    async open(url) {
      scene = new Scene()
      await PLYLoader.LoadAsync(url, scene)
    },

    async draw(view) {
      renderer.setSize(view.width, view.height)
      const camera = posed(view) // a new one each time: it reads focal lengths when it first draws a camera
      const program = renderer.renderProgram
      const before = program.depthIndex
      await drawUntil(
        () => program.depthIndex !== before && program.depthIndex.length === program.renderData.vertexCount,
        () => renderer.render(scene, camera),
      )
      return readPixels(renderer.gl, view, view.background)
    },
  }
}

// A camera with exactly this view, but the depths that are its own: what is nearer or farther it does not draw.
function posed(view) {
  const camera = new Camera()
  const data = camera.data
  data.fx = (view.projection[0] * view.width) / 2
  data.fy = (view.projection[5] * view.height) / 2
  data.setSize = () => {}
  const projection = view.projection.map((value, i) => value * SIGNS[i >> 2])
  for (const i of [2, 6, 10, 14]) projection[i] = data.projectionMatrix.buffer[i]
  data._projectionMatrix = new Matrix4(...projection)
  data._viewMatrix = new Matrix4(...view.viewmat.map((value, i) => value * SIGNS[i & 3]))
  data._viewProj = data.projectionMatrix.multiply(data.viewMatrix)
  camera.update = () => {}
  return camera
}
