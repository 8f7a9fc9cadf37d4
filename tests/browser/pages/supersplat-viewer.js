import { defaultSettings } from '@playcanvas/supersplat-viewer/settings.js'
import { createViewer } from '@playcanvas/supersplat-viewer/viewer.js'
import * as pc from 'playcanvas'
import { canvas, drawToTexture, drawUntil, nextFrame, readPixels, readTexture } from './common.js'
import { isSorted } from './playcanvas.js'

const STYLE = import.meta.resolve('@playcanvas/supersplat-viewer/viewer.css')

// The viewer itself, with the settings that it has without a file of them. `renderer`: webgpu, its default, or webgl. Others are its own, such as aa.
export async function start({ renderer = 'webgpu', ...settings }) {
  const target = renderer === 'webgpu' && drawToTexture()
  document.head.append(Object.assign(document.createElement('link'), { rel: 'stylesheet', href: STYLE }))
  let container = canvas
  let viewer = null
  let view = null
  let asked = false

  // The viewer turns a file by half a turn about z, for most have y down.
  function pose(eye) {
    const world = new pc.Mat4().set(view.viewmat.map((value, i) => (i < 8 ? -value : value))).invert()
    eye.setPosition(world.getTranslation())
    eye.setRotation(new pc.Quat().setFromMat4(world))
    eye.camera.clearColor = new pc.Color(...view.background, 1)
    // The viewer sets a field of view in each frame, of which the engine makes a matrix before it asks `calculateProjection`.
    eye.camera.camera._evaluateProjectionMatrix = function () {
      this._projMat.set(view.projection)
    }
  }

  return {
    async open(url) {
      viewer?.destroy()
      view = null
      const place = Object.assign(document.createElement('div'), { style: 'position: relative; width: 100px; height: 100px' })
      container.replaceWith(place)
      container = place
      viewer = await createViewer({ container, settings: defaultSettings(), contentUrl: url, ui: false, renderer, ...settings })
      const { app } = viewer
      if (app.graphicsDevice.isWebGPU !== Boolean(target)) throw new Error(`this browser has no ${renderer}`)
      app.on('framerender', () => {
        if (!view) return
        pose(app.root.findByName('camera'))
        app.renderNextFrame = asked // and not whenever the viewer has moved its camera back: a software GPU would fall behind
        asked = false
      })
      while (!viewer.state.loaded) await nextFrame()
      app.scene.gsplat.colorUpdateAngle = 0 // a viewer in motion reuses colors
    },

    async draw(wanted) {
      view = wanted
      Object.assign(container.style, { width: `${view.width}px`, height: `${view.height}px` })
      const { app } = viewer
      const { graphicsDevice: device } = app
      const eye = app.root.findByName('camera')
      const frame = () => {
        asked = true
        return new Promise((resolve) => app.once('frameend', resolve))
      }
      while (device.width !== view.width || device.height !== view.height) await frame()
      await drawUntil(() => isSorted(app, eye), frame)
      await drawUntil(() => isSorted(app, eye), frame)
      return target ? readTexture(target) : readPixels(device.gl, view)
    },
  }
}
