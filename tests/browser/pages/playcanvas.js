import * as pc from 'playcanvas'
import { canvas, drawToTexture, drawUntil, nextFrame, readPixels, readTexture } from './common.js'

// 1 - cosine of the milliradian that the engine lets a camera turn before it sorts again.
const SORT_TURN = 1e-6

// World units that it lets a camera move before it sorts again by distance.
const SORT_MOVE = 1e-3

// Milliseconds that the levels of one view may take to load.
const LONGEST_LOAD = 30000

// `device`: webgl2 or webgpu. `settings`: of the engine's `scene.gsplat`, such as antiAlias; its defaults are what its users see.
export async function start({ device: type = 'webgl2', ...settings }) {
  const target = type === 'webgpu' && drawToTexture()
  const device = await pc.createGraphicsDevice(canvas, { deviceTypes: [type], antialias: false })
  if (device.deviceType !== type) throw new Error(`this browser has no ${type}`)
  device.maxPixelRatio = 1
  const options = new pc.AppOptions()
  options.graphicsDevice = device
  options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem]
  options.resourceHandlers = [pc.GSplatHandler, pc.TextureHandler, pc.ContainerHandler]
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
    // `component`: settings of the splats' component, such as lodBaseDistance.
    async open(url, component = {}) {
      if (shown) {
        shown.entity.destroy()
        app.assets.remove(shown.asset)
        shown.asset.unload()
      }
      const asset = new pc.Asset('splats', url.endsWith('.glb') ? 'container' : 'gsplat', { url })
      await new Promise((resolve, reject) => {
        asset.once('load', resolve)
        asset.once('error', (message) => reject(new Error(message)))
        app.assets.add(asset)
        app.assets.load(asset)
      })
      const entity = new pc.Entity('splats')
      entity.addComponent('gsplat', { asset: asset.resource.gsplats?.[0] ?? asset, ...component })
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
      // Levels that are asked for come from the server; then they are sorted anew.
      for (let since = performance.now(); !isStreamed(app, eye); ) {
        if (performance.now() - since > LONGEST_LOAD) throw new Error('the levels were still loading')
        await frame()
        await nextFrame()
      }
      await drawUntil(() => isSorted(app, eye), frame)
      return target ? readTexture(target) : readPixels(device.gl, view)
    },

    levels: () => levelsOf(app, eye),
  }
}

// How many splats of each level the last picture has, of a streamed file.
export function levelsOf(app, eye) {
  const counts = []
  for (const { octree, nodeInfos } of octrees(app, eye)) {
    nodeInfos.forEach(({ currentLod }, i) => {
      if (currentLod >= 0) counts[currentLod] = (counts[currentLod] ?? 0) + octree.nodes[i].lods[currentLod].count
    })
  }
  return Array.from(counts, (count) => count ?? 0)
}

// What draws the splats for a camera, in each layer.
function managersOf(app, eye) {
  const layers = app.renderer.gsplatDirector.camerasMap.get(eye.camera.camera)?.layersMap.values() ?? []
  return [...layers].map((layer) => layer.gsplatManager).filter(Boolean)
}

function octrees(app, eye) {
  return managersOf(app, eye).flatMap(({ world }) => [...world._octreeInstances.values()])
}

// Whether every chunk of a streamed file shows the level that it should from here. The engine looks every tenth frame, and draws what it then found
// ten frames later.
export function isStreamed(app, eye) {
  const isNear = ({ world }) => world._lastLodCameraPos.distance(eye.getPosition()) <= app.scene.gsplat.lodUpdateDistance
  const isShown = ({ currentLod, optimalLod }) => optimalLod >= 0 && currentLod === optimalLod
  const isWhole = (instance) => !instance.dirtyModifiedPlacements && instance.pendingLoadCount === 0 && instance.nodeInfos.every(isShown)
  const all = octrees(app, eye)
  return all.length === 0 || (managersOf(app, eye).every(isNear) && all.every(isWhole))
}

// Whether the order that is drawn is that of this camera, and none is on its way. Sorted by distance it depends on the camera's place only.
export function isSorted(app, eye) {
  const managers = managersOf(app, eye)
  const isOfCamera = ({ lastSortCameraFwd, lastSortCameraPos }) =>
    app.scene.gsplat.radialSorting ? lastSortCameraPos.distance(eye.getPosition()) <= SORT_MOVE : lastSortCameraFwd.dot(eye.forward) > 1 - SORT_TURN
  const settled = (manager) =>
    !manager.sortNeeded &&
    !manager.cpuSorter?.jobsInFlight &&
    !manager.cpuSorter?.pendingSorted &&
    manager.world.currentVersion === manager.world.lastWorldStateVersion &&
    isOfCamera(manager)
  return managers.length > 0 && managers.every(settled)
}
