import * as pc from 'playcanvas'
import { canvas, drawToTexture, drawUntil, readPixels, readTexture } from './common.js'

// 1 - cosine of the milliradian that the engine lets a camera turn before it sorts again.
const SORT_TURN = 1e-6

// `device`: webgl2 or webgpu. `settings`: of the engine's `scene.gsplat`, such as antiAlias; its defaults are what its users see.
export async function start({ device: type = 'webgl2', ...settings }) {
  const target = type === 'webgpu' && drawToTexture()
  const device = await pc.createGraphicsDevice(canvas, { deviceTypes: [type], antialias: false })
  if (device.deviceType !== type) throw new Error(`this browser has no ${type}`)
  device.maxPixelRatio = 1
  const options = new pc.AppOptions()
  options.graphicsDevice = device
  options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem]
  options.resourceHandlers = [pc.GSplatHandler]
  const app = new pc.AppBase(canvas)
  app.init(options)
  app.setCanvasFillMode(pc.FILLMODE_NONE)
  app.autoRender = false
  // Colors follow the view exactly: a viewer in motion reuses them within ten degrees.
  Object.assign(app.scene.gsplat, { colorUpdateAngle: 0, ...settings })
  app.start()

  const eye = new pc.Entity('eye')
  eye.addComponent('camera', { nearClip: 0.01, farClip: 1000, toneMapping: pc.TONEMAP_NONE, gammaCorrection: pc.GAMMA_SRGB })
  app.root.addChild(eye)
  let shown = null

  const frame = () => {
    app.renderNextFrame = true
    return new Promise((resolve) => app.once('frameend', resolve))
  }

  return {
    async open(url) {
      if (shown) {
        shown.entity.destroy()
        app.assets.remove(shown.asset)
        shown.asset.unload()
      }
      const asset = new pc.Asset('splats', 'gsplat', { url })
      await new Promise((resolve, reject) => {
        asset.once('load', resolve)
        asset.once('error', (message) => reject(new Error(message)))
        app.assets.add(asset)
        app.assets.load(asset)
      })
      const entity = new pc.Entity('splats')
      entity.addComponent('gsplat', { asset })
      app.root.addChild(entity)
      shown = { asset, entity }
    },

    async draw(view) {
      device.setResolution(view.width, view.height)
      const world = new pc.Mat4().set(view.viewmat).invert()
      eye.setPosition(world.getTranslation())
      eye.setRotation(new pc.Quat().setFromMat4(world))
      eye.camera.clearColor = new pc.Color(...view.background, 1)
      eye.camera.fov = (2 * Math.atan(1 / view.projection[5]) * 180) / Math.PI
      eye.camera.calculateProjection = (matrix) => matrix.set(view.projection)
      // A sort is asked for in one frame, done by a worker, and taken over in a later one, whose picture is the first in order.
      await drawUntil(() => isSorted(app, eye), frame)
      return target ? readTexture(target) : readPixels(device.gl, view)
    },
  }
}

// Whether the order that is drawn is that of this camera, and none is on its way.
function isSorted(app, eye) {
  const layers = app.renderer.gsplatDirector.camerasMap.get(eye.camera.camera)?.layersMap.values() ?? []
  const managers = [...layers].map((layer) => layer.gsplatManager).filter(Boolean)
  const settled = ({ cpuSorter, world, sortNeeded, lastSortCameraFwd }) =>
    !sortNeeded &&
    !cpuSorter?.jobsInFlight &&
    !cpuSorter?.pendingSorted &&
    world.currentVersion === world.lastWorldStateVersion &&
    lastSortCameraFwd.dot(eye.forward) > 1 - SORT_TURN
  return managers.length > 0 && managers.every(settled)
}
